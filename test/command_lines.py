# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run commands as processes, send them signals, and check their error messages."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import kfvo_ros
from kfvo_ros.utils.process import time_limit

MARK = f'KFVO_TEST_PROCESS={os.getpid()}'
"""Environment variable of all processes that tests start."""
HELPERS = ('multiprocessing.resource_tracker', 'multiprocessing.forkserver')
os.environ.update([MARK.split('=')])
# A sourced ROS is already on the path.
ENVIRONMENT = os.environ | {'PYTHONPATH': os.pathsep.join(
    filter(None, [str(Path(kfvo_ros.__file__).parents[1]), os.environ.get('PYTHONPATH')]))}


@contextmanager
def started(*arguments: object, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Start Python in a session of its own, all of whose processes end with the ``with``."""
    defaults = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE, 'text': True,
                'env': ENVIRONMENT, 'start_new_session': True}
    process = subprocess.Popen([sys.executable, *map(str, arguments)], **(defaults | options))
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def run_python(*arguments: object, timeout_s: float = 120.0,
               **options: Any) -> subprocess.CompletedProcess[str]:
    """Run Python with arguments such as ``-m module`` or ``-c code`` to its end."""
    with started(*arguments, **options) as process:
        output, errors = process.communicate(timeout=time_limit(timeout_s))
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)


def run_interrupted(sent: signal.Signals, ready: Callable[[], bool], *arguments: object
                    ) -> tuple[int, str, str]:
    """Start Python, send it a signal once it is `ready`; return exit status, stdout, stderr."""
    with started(*arguments) as process:
        deadline = time.monotonic() + time_limit(60.0)
        while not ready():
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
        process.send_signal(sent)
        output, errors = process.communicate(timeout=time_limit(30.0))
    return process.returncode, output, errors


def leftovers(wait_s: float) -> dict[int, str]:
    """Return the command lines of processes started here that still run after `wait_s`.

    The helpers of multiprocessing, which end with this process, do not count.
    """
    end = time.monotonic() + wait_s
    while (found := _marked()) and time.monotonic() < end:
        time.sleep(0.02)
    return found


def _marked() -> dict[int, str]:
    found = {}
    for path in Path('/proc').glob('[0-9]*/environ'):
        number = int(path.parent.name)
        with suppress(OSError):
            if MARK.encode() in path.read_bytes().split(b'\0') and is_running(number):
                command = (path.parent / 'cmdline').read_text('utf-8', 'replace')
                if not any(helper in command for helper in HELPERS):
                    found[number] = command.replace('\0', ' ')
    return found


def children_of(parent: int) -> list[int]:
    """Return the running child processes of a process."""
    found = []
    for path in Path('/proc').glob('[0-9]*/stat'):
        state, ppid = _state(int(path.parent.name))
        if ppid == parent and state != 'Z':
            found.append(int(path.parent.name))
    return found


def is_running(process: int) -> bool:
    """Whether a process exists, and is no zombie that waits for its parent."""
    return _state(process)[0] not in ('', 'Z')


def _state(process: int) -> tuple[str, int]:
    """Return the state of a process, '' if it has ended, and its parent."""
    try:
        _, _, fields = Path('/proc', str(process), 'stat').read_text().rpartition(')')
    except OSError:
        return '', 0
    return fields.split()[0], int(fields.split()[1])


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
