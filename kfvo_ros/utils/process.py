# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM: as one exception, held back, collected or ignored."""

from __future__ import annotations

import math
import os
import platform
import re
import resource
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
from threadpoolctl import threadpool_limits

SIGNALS = (signal.SIGINT, signal.SIGTERM)
CPU_LIST = Path('/proc/cpuinfo')


class Interrupted(KeyboardInterrupt):
    """SIGINT or SIGTERM came.

    A KeyboardInterrupt itself, once it has passed through an `exec` (as dataclasses use), makes
    Python end by SIGINT at last, caught or not.
    """


def raise_on_signals(even_ignored: bool) -> None:
    """Let either signal raise Interrupted in the main thread.

    A signal that this process was started to ignore, as shells start what a script puts in the
    background, does so only if `even_ignored`.
    """
    for number in SIGNALS:
        if even_ignored or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)


def ignore_signals() -> None:
    """Let nothing disturb the clean-up: another Ctrl-C would end it in a traceback."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Hold signals back: rclpy tells of one during its import as of a broken installation."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


@contextmanager
def signals_collected() -> Iterator[list[int]]:
    """Give a list that grows by each signal, which raises nothing and cuts nothing in two."""
    received: list[int] = []
    previous = {number: signal.signal(number, lambda number, _: received.append(number))
                for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: Any) -> None:
    raise Interrupted


@contextmanager
def single_threaded() -> Iterator[None]:
    """Keep BLAS and OpenCV to one thread in this process."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)


def peak_rss_mb() -> float:
    """Return the largest resident memory of this process so far [MiB]."""
    # getrusage would count what the parent held before it started this program.
    return _memory_mb('VmHWM')


def rss_mb() -> float:
    """Return the resident memory of this process now, or where nobody tells, at its most [MiB]."""
    return _memory_mb('VmRSS')


def available_mb() -> float:
    """Return the memory that can be had without swapping [MiB], infinity where nobody tells."""
    return _listed_mb('/proc/meminfo', 'MemAvailable') or math.inf


def _memory_mb(key: str) -> float:
    listed = _listed_mb('/proc/self/status', key)
    if listed is not None:
        return listed
    unit = 1024.0 ** 2 if sys.platform == 'darwin' else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _listed_mb(file: str, key: str) -> float | None:
    """Return an entry [MiB] of one of Linux's lists, None where there is none."""
    path = Path(file)
    found = path.exists() and re.search(rf'^{key}:\s*(\d+) kB', path.read_text('ascii'), re.M)
    return int(found[1]) / 1024.0 if found else None


class Stopwatch:
    """``with clock('encode'): ...`` adds to ``clock.durations['encode']`` [s]."""

    def __init__(self) -> None:
        self.durations: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        """Time the block under the name `step`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.durations[step] = self.durations.get(step, 0.0) + elapsed


def host_info() -> str:
    """Return processor, number of cores and Python's version."""
    return f'{_processor()}, {os.cpu_count()} cores, Python {platform.python_version()}'


def _processor() -> str:
    """Return the processor's own name, or where nobody tells, its architecture."""
    listed = CPU_LIST.read_text('utf-8', 'replace') if CPU_LIST.exists() else ''
    model = re.search(r'^model name\s*: *(.+)$', listed, re.MULTILINE)
    return model[1].strip() if model else platform.processor() or platform.machine()
