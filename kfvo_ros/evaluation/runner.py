# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark runs: ``python -m kfvo_ros.run`` in one process and one folder each."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.evaluation.results import SUMMARY
from kfvo_ros.utils.children import start_child
from kfvo_ros.utils.files import atomic_write
from kfvo_ros.utils.signals import POLL_S, raise_if_interrupted

if TYPE_CHECKING:
    from kfvo_ros.evaluation.plan import BenchmarkSequence

REQUEST, LOG = 'request.json', 'log.txt'
ERROR_PREFIX = 'kfvo_run: error: '
REMEDY = 'resume with the same options, or choose another --output, or --overwrite'
TERMINATE_TIMEOUT_S = 20.0
"""After SIGTERM a process writes what it has; after this time it is killed."""


@dataclass(frozen=True)
class Run:
    """A ``sequence`` by a ``method`` with a ``seed``, all files in ``folder``.

    ``arguments`` are those of ``run`` after the sequence, ``policy_sha256`` the checksum of the
    policy file of a learned method, ``conditions`` further entries of request.json.
    """

    sequence: BenchmarkSequence
    method: str
    seed: int
    folder: Path
    arguments: tuple[str, ...]
    policy_sha256: str | None
    conditions: dict[str, Any]

    def is_finished(self) -> bool:
        """Return whether an earlier run is complete; raises KfvoError if its options differ."""
        if 'frames' not in self.summary() or 'ended_early' in self.summary():
            return False
        earlier = self.request()
        if earlier.get('arguments') != self._command:
            other = shlex.join(earlier.get('arguments', ()))
            raise KfvoError(f'{self.folder} holds a run of {other!r}; expected '
                            f'{shlex.join(self._command)!r} as now: {REMEDY}')
        if earlier.get('policy') != self.policy_sha256:
            raise KfvoError(f'{self.folder} is of another policy of the same name: {REMEDY}')
        return True

    def start(self) -> subprocess.Popen[bytes]:
        """Start the process; its files replace those of an earlier run. Raises KfvoError."""
        request = {'arguments': self._command, 'policy': self.policy_sha256, **self.conditions}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.folder / REQUEST) as draft:
                draft.write_text(json.dumps(request, indent=2) + '\n', encoding='utf-8')
            (self.folder / SUMMARY).unlink(missing_ok=True)
            with (self.folder / LOG).open('wb') as log:
                return start_child(
                    'kfvo_ros.run',
                    [*self._command, '--overwrite', '--output', str(self.folder)],
                    stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                    env=os.environ | {'TQDM_DISABLE': '1'})
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error

    def problem(self, status: int) -> str | None:
        """Return in one line why the process failed, None for exit status 0."""
        if status == 0:
            return None
        if status < 0:
            return f'the process was ended by {signal.Signals(-status).name}'
        early = self.summary().get('ended_early')
        if early is not None:
            return str(early)
        lines = (self.folder / LOG).read_text('utf-8', 'replace').splitlines() or ['']
        errors = [line.partition(ERROR_PREFIX)[2] for line in lines if ERROR_PREFIX in line]
        # Without such a line the log ends in a traceback, whose last line names the exception.
        return errors[-1] if errors else \
            f'{lines[-1].strip()} (all of it in {self.folder / LOG})'

    def summary(self) -> dict[str, Any]:
        """Return summary.json of the process, {} where it is missing or incomplete."""
        return _read_json(self.folder / SUMMARY)

    def request(self) -> dict[str, Any]:
        """Return request.json, {} where it is missing: how the process was started."""
        return _read_json(self.folder / REQUEST)

    @property
    def _command(self) -> list[str]:
        return [self.sequence.text, *self.arguments]


def run_in_parallel(runs: Iterable[Run], jobs: int,
                    on_end: Callable[[Run, str | None], None]) -> None:
    """Run `runs`, `jobs` at a time; call `on_end` with each run and its problem, None if none.

    Raises Interrupted after a signal, and what `on_end` raises, once all processes have ended.
    """
    waiting, running = deque(runs), dict[subprocess.Popen[bytes], Run]()
    try:
        while waiting or running:
            raise_if_interrupted()
            while waiting and len(running) < jobs:
                run = waiting.popleft()
                running[run.start()] = run
            time.sleep(POLL_S)
            for process in [each for each in running if each.poll() is not None]:
                raise_if_interrupted()  # Ctrl-C reached this process too: no problem of its own
                run = running.pop(process)
                on_end(run, run.problem(process.returncode))
    finally:
        _terminate(running)


def _terminate(processes: Iterable[subprocess.Popen[bytes]]) -> None:
    """End all processes, and kill those that outlast TERMINATE_TIMEOUT_S."""
    processes = tuple(processes)
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + TERMINATE_TIMEOUT_S
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _read_json(path: Path) -> dict[str, Any]:
    """Return the object in a file, {} where there is none."""
    try:
        content = json.loads(path.read_text('utf-8'))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
