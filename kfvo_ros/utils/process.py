# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""This process and its host: threads, memory, durations of steps, the processor's name."""

from __future__ import annotations

import math
import os
import platform
import re
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
from threadpoolctl import threadpool_limits

CPU_LIST = Path('/proc/cpuinfo')


@contextmanager
def single_threaded() -> Iterator[None]:
    """Run BLAS and OpenCV in one thread: threads do not pay for the small matrices of a window."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)


def peak_rss_mb() -> float:
    """Return the peak resident memory of this process so far [MiB]."""
    # getrusage would count what the parent held before it started this program.
    return _memory_mb('VmHWM')


def rss_mb() -> float:
    """Return the resident memory of this process now [MiB]; its peak where /proc is missing."""
    return _memory_mb('VmRSS')


def available_mb() -> float:
    """Return the memory available without swapping [MiB], infinity where it is unknown."""
    return _listed_mb('/proc/meminfo', 'MemAvailable') or math.inf


def _memory_mb(key: str) -> float:
    listed = _listed_mb('/proc/self/status', key)
    if listed is not None:
        return listed
    unit = 1024.0 ** 2 if sys.platform == 'darwin' else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _listed_mb(file: str, key: str) -> float | None:
    """Return an entry [MiB] of a list below /proc, None where there is none."""
    path = Path(file)
    found = path.exists() and re.search(rf'^{key}:\s*(\d+) kB', path.read_text('ascii'), re.M)
    return int(found[1]) / 1024.0 if found else None


class Stopwatch:
    """Durations of named steps: ``with clock('encode'):`` adds to ``clock.durations`` [s]."""

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
    """Return the model name of the processor, or its architecture where that is unknown."""
    listed = CPU_LIST.read_text('utf-8', 'replace') if CPU_LIST.exists() else ''
    model = re.search(r'^model name\s*: *(.+)$', listed, re.MULTILINE)
    return model[1].strip() if model else platform.processor() or platform.machine()
