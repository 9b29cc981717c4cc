# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How much memory this process uses, and how much there is."""

from __future__ import annotations

import math
import re
import resource
import sys
from pathlib import Path


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
