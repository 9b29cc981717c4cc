# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Processes of commands: each in a session of its own, observed, and ended with its children."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

from kfvo_ros.utils.signals import raise_if_interrupted

POLL_S = 0.02
GRACE_S = 10.0
"""Time in which the children of a killed process must end."""
ROOT = Path(__file__).resolve().parents[2]


class Session:
    """A command in a session of its own, which is killed as a whole at the end of the ``with``.

    Its output goes to ``log``. `file_bytes` limits the size of the files that it writes.
    """

    def __init__(self, arguments: list[str], log: Path, file_bytes: int | None = None) -> None:
        environment = os.environ | {'TQDM_DISABLE': '1', 'PYTHONFAULTHANDLER': '1'}
        environment['PYTHONPATH'] = os.pathsep.join(
            filter(None, [str(ROOT), os.environ.get('PYTHONPATH')]))
        self._log = log
        with log.open('wb') as file:
            self.process = subprocess.Popen(
                [sys.executable, '-m', *arguments], stdin=subprocess.DEVNULL, stdout=file,
                stderr=file, env=environment, start_new_session=True,
                preexec_fn=None if file_bytes is None else _limit_files(file_bytes))

    def __enter__(self) -> Session:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 place: TracebackType | None) -> None:
        self.process.kill()  # not by its number, which may be of another process by now
        for number in self.survivors():
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        self.process.wait()

    @property
    def output(self) -> str:
        """What the command printed so far."""
        return self._log.read_text('utf-8', 'replace')

    def wait(self, timeout_s: float) -> int | None:
        """Return the exit status, negative for a signal; None if it still runs at the end."""
        self.wait_until(lambda: self.process.poll() is not None, timeout_s)
        return self.process.poll()

    def wait_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait for a condition, at most until the command ends; return whether it holds."""
        end = time.monotonic() + timeout_s
        while not condition() and time.monotonic() < end and self.process.poll() is None:
            raise_if_interrupted()
            time.sleep(POLL_S)
        return condition()

    def handles_signals(self) -> bool:
        """Whether the command has set its signal handlers; before that it has done nothing."""
        with suppress(OSError):
            for line in Path(f'/proc/{self.process.pid}/status').read_text().splitlines():
                if line.startswith('SigCgt:'):
                    return bool(int(line.split()[1], 16) >> (signal.SIGTERM - 1) & 1)
        return False

    def survivors(self, timeout_s: float = 0.0) -> list[int]:
        """Return the processes of the session that outlive the command by `timeout_s`."""
        end = time.monotonic() + timeout_s
        while (found := self._members()) and time.monotonic() < end:
            time.sleep(POLL_S)
        return found

    def _members(self) -> list[int]:
        found = []
        for folder in Path('/proc').iterdir():
            with suppress(OSError, ValueError):
                number = int(folder.name)
                state, _, _, session = (folder / 'stat').read_text().rpartition(')')[2].split()[:4]
                if int(session) == self.process.pid and state != 'Z' \
                        and number != self.process.pid:
                    found.append(number)
        return found


def _limit_files(size: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[bool]:
    """Mount a tmpfs of `size` bytes at a folder; yield whether that is permitted."""
    folder.mkdir(parents=True)
    mounted = subprocess.run(['mount', '-t', 'tmpfs', '-o', f'size={size}', 'tmpfs', folder],
                             capture_output=True).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(['umount', '-l', folder], capture_output=True)
