# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Process and host: threads, memory, durations of steps, speed, name of the processor."""

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
from functools import cache
from pathlib import Path

import cv2
from threadpoolctl import threadpool_limits

from kfvo_ros.errors import KfvoError, quoted

CPUINFO = Path('/proc/cpuinfo')
TIME_FACTOR = 'KFVO_TIME_FACTOR'
"""Environment variable: a factor for all time limits, where the measured one does not suffice."""
LOOPS, REFERENCE_S = 300_000, 0.010
"""A loop in Python, and its time on a laptop of 2023 [s]."""
LIMIT_MARGIN = 2.0


@contextmanager
def single_threaded() -> Iterator[None]:
    """Run BLAS and OpenCV in one thread: more are slower on the small matrices of a window."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)


def peak_rss_mb() -> float:
    """Return the peak resident memory of this process so far [MiB]."""
    # ru_maxrss of getrusage includes the memory of the parent before exec.
    return _memory_mb('VmHWM')


def rss_mb() -> float:
    """Return the resident memory of this process now [MiB]; its peak where /proc is missing."""
    return _memory_mb('VmRSS')


def available_mb() -> float:
    """Return the memory available without swapping [MiB], infinity where it is unknown."""
    return _read_mb('/proc/meminfo', 'MemAvailable') or math.inf


def _memory_mb(key: str) -> float:
    listed = _read_mb('/proc/self/status', key)
    if listed is not None:
        return listed
    unit = 1024.0 ** 2 if sys.platform == 'darwin' else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _read_mb(file: str, key: str) -> float | None:
    """Return an entry [MiB] of a file below /proc, None where there is none."""
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


def time_limit(seconds: float) -> float:
    """Return the time limit [s] here and now for what takes up to `seconds` on a free machine.

    It grows with the measured slowness of the processor and with the load of the machine. Raises
    KfvoError unless KFVO_TIME_FACTOR, where set, is a positive number.
    """
    text = os.environ.get(TIME_FACTOR) or '1'
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan
    if not 0.0 < factor < math.inf:
        raise KfvoError(f'{TIME_FACTOR}: expected a positive number, came {quoted(text)}')
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    return seconds * LIMIT_MARGIN * _slowness() * (1.0 + load) * factor


@cache
def _slowness() -> float:
    """Return the processor's time for a loop over the reference, at least 1."""
    start = time.process_time()
    for _ in range(LOOPS):
        pass
    return max(1.0, (time.process_time() - start) / REFERENCE_S)


def host_info() -> str:
    """Return processor, number of cores and version of Python."""
    return f'{_processor()}, {os.cpu_count()} cores, Python {platform.python_version()}'


def _processor() -> str:
    """Return the model name of the processor, its architecture where unknown."""
    listed = CPUINFO.read_text('utf-8', 'replace') if CPUINFO.exists() else ''
    model = re.search(r'^model name\s*: *(.+)$', listed, re.MULTILINE)
    return model[1].strip() if model else platform.processor() or platform.machine()
