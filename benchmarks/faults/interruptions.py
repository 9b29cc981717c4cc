# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands under signals at random moments, kill -9 with resume, and full disks."""

from __future__ import annotations

import os
import re
import signal
import time
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.faults.commands import (
    BENCHMARK,
    COMMANDS,
    CONVERT,
    NODE,
    RUN,
    TRAIN,
    Command,
    Inputs,
    make_inputs,
    results_of,
)
from benchmarks.faults.outcomes import MAX_REASON, Outcome, Result, Verdict
from benchmarks.faults.processes import GRACE_S, Session, small_disk
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.process import time_limit
from kfvo_ros.utils.signals import SIGNALS, raise_if_interrupted

FINISH_S, STOP_S = 300.0, 30.0
"""Limits for a whole command, and for its end after a signal, on a free machine."""
NODE_S = 3.0
"""Length of a node's life after it is ready."""
SMALLEST_DISK, LARGEST_DISK, PAGE = 4096, 65536, 4096
TRACEBACK = re.compile(r'^(Traceback|Exception ignored|Fatal Python error)', re.MULTILINE)


@dataclass(frozen=True)
class ProcessTry:
    """One fault of a command: ``fault`` is ``signal``, ``kill`` or ``disk``."""

    fault: str
    command: Command
    number: int

    @property
    def label(self) -> str:
        """Name in the table."""
        return {'signal': f'signal to {self.command.name}', 'kill': f'kill -9 {self.command.name}',
                'disk': f'full disk, {self.command.name}'}[self.fault]


FAULTS = (*(('signal', command, 40) for command in COMMANDS),
          ('kill', BENCHMARK, 10), ('kill', TRAIN, 10),
          *(('disk', command, 20) for command in (RUN, CONVERT, TRAIN, BENCHMARK)))
"""Faults, commands and the number of tries of a full run."""


@dataclass
class ProcessFaults:
    """Tries faults of processes in the folder ``work``; ``disk`` is how disks are made small."""

    work: Path
    seed: int
    jobs: int = 2
    disk: str = ''
    _durations: dict[str, float] = field(default_factory=dict)
    _reference: list[tuple[str, ...]] = field(default_factory=list)

    def outcomes(self, tries: list[ProcessTry]) -> Iterator[Result]:
        """Yield the result of each try, as they come.

        Raises KfvoError where a command fails undisturbed.
        """
        self._inputs = make_inputs(self.work)
        commands = {each.command.name: each.command for each in tries}
        with _playing(self._inputs, self.work, NODE.name in commands):
            for command in commands.values():
                self._measure(command)
            with ThreadPoolExecutor(self.jobs) as pool:
                futures = [pool.submit(self._try, each) for each in tries]
                try:
                    for future in as_completed(futures):
                        yield future.result()
                finally:
                    for future in futures:
                        future.cancel()

    def _measure(self, command: Command) -> None:
        """Run a command undisturbed, and keep how long it handles signals."""
        folder = self.work / f'undisturbed_{command.name}'
        folder.mkdir()
        with self._start(command.arguments(self._inputs, folder), folder) as session:
            session.wait_until(session.handles_signals, time_limit(FINISH_S))
            begin = time.monotonic()
            if command.until_stopped:
                session.wait_until(lambda: 'ready' in session.output, time_limit(FINISH_S))
                time.sleep(NODE_S)
                session.process.send_signal(signal.SIGINT)
            status = session.wait(time_limit(FINISH_S))
            self._durations[command.name] = time.monotonic() - begin
            problem = command.problem(self._inputs, folder, True)
            if status != 0 or problem:
                raise KfvoError(f'{command.name}: expected to finish undisturbed, came status '
                                f'{status}: {problem or _last_line(session.output)}')
        if command is BENCHMARK:
            self._reference = results_of(folder)

    def _try(self, each: ProcessTry) -> Result:
        rng = np.random.default_rng([self.seed, zlib.crc32(each.label.encode()), each.number])
        folder = self.work / f'{each.fault}_{each.command.name}_{each.number}'
        folder.mkdir()
        act = {'signal': self._interrupt, 'kill': self._kill, 'disk': self._fill}[each.fault]
        verdict, description = act(each.command, folder, rng)
        return Result(each.label, each.number, verdict, description, folder,
                      self.disk if each.fault == 'disk' else '')

    def _interrupt(self, command: Command, folder: Path, rng: np.random.Generator
                   ) -> tuple[Verdict, str]:
        """Send a signal at a random moment."""
        sent = SIGNALS[int(rng.integers(len(SIGNALS)))]
        moment_s = float(rng.random()) * self._durations[command.name]
        description = f'{sent.name} after {moment_s:.2f} s'
        with self._start(command.arguments(self._inputs, folder), folder) as session:
            session.wait_until(session.handles_signals, time_limit(FINISH_S))
            session.wait(moment_s)
            session.process.send_signal(sent)
            status = session.wait(time_limit(STOP_S))
            left = session.survivors(time_limit(GRACE_S))
            verdict = _judge_end(status, sent, command, session.output, left)
        if verdict.outcome is not Outcome.OK:
            return verdict, description
        complete = status == 0 and not command.until_stopped
        return _judge_files(command.problem(self._inputs, folder, complete)), description

    def _kill(self, command: Command, folder: Path, rng: np.random.Generator
              ) -> tuple[Verdict, str]:
        """Kill a command at a random moment, and resume it."""
        assert command.resume is not None
        moment_s = float(rng.random()) * self._durations[command.name]
        description = f'SIGKILL after {moment_s:.2f} s, then resumed'
        with self._start(command.arguments(self._inputs, folder), folder) as session:
            session.wait_until(session.handles_signals, time_limit(FINISH_S))
            session.wait(moment_s)
            session.process.kill()
            session.process.wait()
            left = session.survivors(time_limit(GRACE_S))
            if left:
                return Verdict(Outcome.HANG, f'{len(left)} children survive'), description
        with self._start(command.resume(self._inputs, folder), folder) as session:
            status = session.wait(time_limit(FINISH_S))
            left = session.survivors(time_limit(GRACE_S))
            verdict = _judge_end(status, None, command, session.output, left)
        if verdict.outcome is not Outcome.OK:
            return verdict, description
        problem = command.problem(self._inputs, folder, True)
        if command is BENCHMARK and not problem and results_of(folder) != self._reference:
            problem = 'other results than undisturbed'
        return _judge_files(problem), description

    def _fill(self, command: Command, folder: Path, rng: np.random.Generator
              ) -> tuple[Verdict, str]:
        """Run a command whose files do not fit: one clear error, or all of its results."""
        size = PAGE * int(rng.integers(SMALLEST_DISK // PAGE, LARGEST_DISK // PAGE + 1))
        with small_disk(folder / 'disk', size) as mounted:
            self.disk = 'tmpfs' if mounted else 'RLIMIT_FSIZE, no permission to mount a tmpfs'
            with self._start(command.arguments(self._inputs, folder / 'disk'), folder,
                             None if mounted else size) as session:
                status = session.wait(time_limit(FINISH_S))
                left = session.survivors(time_limit(GRACE_S))
                verdict = _judge_end(status, None, command, session.output, left)
            if verdict.outcome is Outcome.OK:
                verdict = _judge_files(command.problem(self._inputs, folder / 'disk', True))
        return verdict, f'a disk of {size} bytes'

    def _start(self, arguments: list[str], folder: Path, file_bytes: int | None = None) -> Session:
        raise_if_interrupted()
        return Session(arguments, folder / 'output.txt', file_bytes)


def _judge_end(status: int | None, sent: signal.Signals | None, command: Command, output: str,
               left: list[int]) -> Verdict:
    """Return the verdict on the end of a process; OK leaves the files to be judged."""
    if status is None:
        return Verdict(Outcome.HANG, f'still running: {_last_line(output)}')
    if TRACEBACK.search(output):
        return Verdict(Outcome.TRACEBACK, _last_line(output))
    if left:
        return Verdict(Outcome.HANG, f'{len(left)} processes are left')
    allowed = [0]
    if sent is not None and not command.until_stopped:
        allowed.append(128 + sent)
    if status in allowed:
        return Verdict(Outcome.OK)
    if sent is None and status == 1:
        errors = [line for line in output.splitlines() if ': error: ' in line]
        return Verdict(Outcome.CLEAR_ERROR, errors[0]) if len(errors) == 1 else \
            Verdict(Outcome.TRACEBACK, f'expected one error, came {errors}'[:MAX_REASON])
    ended = signal.Signals(-status).name if status < 0 else f'status {status}'
    return Verdict(Outcome.CRASH, f'ended by {ended}, expected {allowed}: {_last_line(output)}')


def _judge_files(problem: str | None) -> Verdict:
    return Verdict(Outcome.OK) if problem is None else Verdict(Outcome.SILENT_LOSS, problem)


def _last_line(output: str) -> str:
    return (output.strip().splitlines() or ['no output'])[-1][:MAX_REASON]


@contextmanager
def _playing(inputs: Inputs, work: Path, needed: bool) -> Iterator[None]:
    """Play the recording again and again, in a domain of this process, while the block runs."""
    if not needed:
        yield
        return
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
    with Session(['kfvo_ros.play', str(inputs.recording), '--loop'], work / 'player.txt'):
        yield

