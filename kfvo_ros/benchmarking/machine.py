# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What machine this is, for people who compare times."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path

CPU_LIST = Path('/proc/cpuinfo')


def machine_name() -> str:
    """Return processor, number of cores and Python's version."""
    return f'{_processor()}, {os.cpu_count()} cores, Python {platform.python_version()}'


def _processor() -> str:
    """Return the processor's own name, or where nobody tells, its architecture."""
    listed = CPU_LIST.read_text('utf-8', 'replace') if CPU_LIST.exists() else ''
    model = re.search(r'^model name\s*: *(.+)$', listed, re.MULTILINE)
    return model[1].strip() if model else platform.processor() or platform.machine()
