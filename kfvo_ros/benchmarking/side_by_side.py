# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Processes side by side, none of which outlives us."""

from __future__ import annotations

import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterable

from kfvo_ros.benchmarking.runs import Run
from kfvo_ros.interruption import Interrupted, signals_collected

POLL_S = 0.02
PATIENCE_S = 20.0
"""A process that is told to end writes down what it has; one that does not is killed."""


def run_side_by_side(runs: Iterable[Run], jobs: int,
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
