# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One cell of a benchmark: ``python -m kfvo_ros.run`` in a process and a folder of its own."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.evaluation.sequences import BenchmarkSequence
from kfvo_ros.odometry.results import SUMMARY
from kfvo_ros.utils.files import atomic_write
from kfvo_ros.utils.process import Interrupted, signals_collected

REQUEST, LOG = 'request.json', 'log.txt'
ERROR = 'kfvo_run: error: '
ELSE = 'go on with that one, or choose another --output, or --overwrite'
POLL_S = 0.02
PATIENCE_S = 20.0
"""A process that is told to end writes down what it has; one that does not is killed."""


@dataclass(frozen=True)
class Run:
    """A ``subject`` by a ``method`` with a ``seed``, all files in ``folder``.

    ``arguments`` are those of ``run`` after the sequence, ``policy`` the sum over the file of a
    learned policy, ``conditions`` what else is told of it.
    """

    subject: BenchmarkSequence
    method: str
    seed: int
    folder: Path
    arguments: tuple[str, ...]
    policy: str | None
    conditions: dict[str, Any]

    def is_finished(self) -> bool:
        """Whether it came to its end before; raises KfvoError if with other options."""
        if 'frames' not in self.summary() or 'ended_early' in self.summary():
            return False
        earlier = self.request()
        if earlier.get('arguments') != self._command:
            other = shlex.join(earlier.get('arguments', ()))
            raise KfvoError(f'{self.folder} holds a run of {other!r}; expected '
                            f'{shlex.join(self._command)!r} as now: {ELSE}')
        if earlier.get('policy') != self.policy:
            raise KfvoError(f'{self.folder} is of another policy of the same name: {ELSE}')
        return True

    def start(self) -> subprocess.Popen[bytes]:
        """Start the process, in place of whatever was there before; raises KfvoError."""
        request = {'arguments': self._command, 'policy': self.policy, **self.conditions}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.folder / REQUEST) as draft:
                draft.write_text(json.dumps(request, indent=2) + '\n', encoding='utf-8')
            (self.folder / SUMMARY).unlink(missing_ok=True)
            with (self.folder / LOG).open('wb') as log:
                return subprocess.Popen(
                    [sys.executable, '-m', 'kfvo_ros.run', *self._command, '--overwrite',
                     '--output', str(self.folder)], stdin=subprocess.DEVNULL, stdout=log,
                    stderr=log, env=os.environ | {'TQDM_DISABLE': '1'})
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error

    def problem(self, status: int) -> str | None:
        """Return in one line why the process failed, None if it did not."""
        if status == 0:
            return None
        if status < 0:
            return f'the process was ended by {signal.Signals(-status).name}'
        early = self.summary().get('ended_early')
        if early is not None:
            return str(early)
        lines = (self.folder / LOG).read_text('utf-8', 'replace').splitlines() or ['']
        told = [line.partition(ERROR)[2] for line in lines if ERROR in line]
        # Without a line of ours it is a traceback, whose last line says most.
        return told[-1] if told else f'{lines[-1].strip()} (all of it in {self.folder / LOG})'

    def summary(self) -> dict[str, Any]:
        """Return what the process wrote, nothing where that is not there in full."""
        return _read_json(self.folder / SUMMARY)

    def request(self) -> dict[str, Any]:
        """Return how the process was started."""
        return _read_json(self.folder / REQUEST)

    @property
    def _command(self) -> list[str]:
        return [self.subject.text, *self.arguments]


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file; raises KfvoError."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise KfvoError(f'cannot read {path}: {reason_of(error)}') from error


def _read_json(path: Path) -> dict[str, Any]:
    try:
        read = json.loads(path.read_text('utf-8'))
    except (OSError, ValueError):
        return {}
    return read if isinstance(read, dict) else {}


def run_in_parallel(runs: Iterable[Run], jobs: int,
                    ended: Callable[[Run, str | None], None]) -> None:
    """Run them all, `jobs` at a time; `ended` is told each run and the problem it had, if any.

    Raises Interrupted at SIGINT or SIGTERM, and what `ended` raises; all processes ended before.
    """
    waiting, running = deque(runs), dict[subprocess.Popen[bytes], Run]()
    with signals_collected() as interruptions:
        try:
            while waiting or running:
                if interruptions:
                    raise Interrupted
                while waiting and len(running) < jobs:
                    run = waiting.popleft()
                    running[run.start()] = run
                time.sleep(POLL_S)
                for process in [each for each in running if each.poll() is not None]:
                    if interruptions:  # Ctrl-C went to that one too: it is not its own problem
                        raise Interrupted
                    run = running.pop(process)
                    ended(run, run.problem(process.returncode))
        finally:
            _end(running)


def _end(processes: Iterable[subprocess.Popen[bytes]]) -> None:
    processes = tuple(processes)
    for process in processes:
        process.terminate()
    until = time.monotonic() + PATIENCE_S
    for process in processes:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
