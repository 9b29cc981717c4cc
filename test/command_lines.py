# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run commands as processes, send them signals, and check their error messages."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import kfvo_ros

# A sourced ROS is already on the path.
ENVIRONMENT = os.environ | {'PYTHONPATH': os.pathsep.join(
    filter(None, [str(Path(kfvo_ros.__file__).parents[1]), os.environ.get('PYTHONPATH')]))}


def run_python(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run Python with arguments such as ``-m module`` or ``-c code`` to its end."""
    defaults = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE, 'text': True,
                'env': ENVIRONMENT, 'timeout': 120.0}
    return subprocess.run([sys.executable, *map(str, arguments)], **(defaults | options))


def run_interrupted(sent: signal.Signals, ready: Callable[[], bool], *arguments: object
                    ) -> tuple[int, str, str]:
    """Start Python, send it a signal once it is `ready`; return exit status, stdout, stderr."""
    process = subprocess.Popen([sys.executable, *map(str, arguments)], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)
    try:
        deadline = time.monotonic() + 60.0
        while not ready():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        process.send_signal(sent)
        output, errors = process.communicate(timeout=30.0)
    finally:
        process.kill()
    return process.returncode, output, errors


def one_readable_line(done: subprocess.CompletedProcess[str]) -> str:
    """Assert that the process failed with one line and no traceback; return the line."""
    assert done.returncode != 0
    assert 'Traceback' not in done.stderr + (done.stdout or '')
    lines = [line for line in done.stderr.splitlines() if 'error:' in line]
    assert len(lines) == 1, done.stderr
    return lines[0]


def assert_one_readable_line(done: subprocess.CompletedProcess[str], *parts: str) -> None:
    """Assert that the process failed with one line that contains `parts`."""
    line = one_readable_line(done)
    assert all(part in line for part in parts), line
