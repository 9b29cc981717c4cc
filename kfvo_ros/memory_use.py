# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How much memory this process uses."""

from __future__ import annotations

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


def _memory_mb(key: str) -> float:
    status = Path('/proc/self/status')
    if status.exists():
        found = re.search(rf'{key}:\s*(\d+) kB', status.read_text(encoding='ascii'))
        if found:
            return int(found[1]) / 1024.0
    unit = 1024.0 ** 2 if sys.platform == 'darwin' else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
