# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Readers in worker processes, which serve for many inputs and are replaced after a crash or hang.

A worker ignores signals of the terminal; it ends when its parent does, as the pipe closes.
"""

from __future__ import annotations

import contextlib
import faulthandler
import multiprocessing
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

from benchmarks.faults.outcomes import MAX_REASON, Answer, Outcome, Verdict
from kfvo_ros.utils.process import time_limit

Reader = Callable[[Path], Answer]
MEMORY_BYTES = 8 * 2 ** 30
"""Address space of a worker; the inputs have a megabyte or less."""
START_S, END_S = 300.0, 5.0
"""Time to read an original first, with imports and perhaps compilation, and to end."""


class Worker:
    """A process that runs readers; ``log`` is the file of what it prints."""

    def __init__(self, log: Path, limit_s: float) -> None:
        self._log, self._limit_s = log, limit_s
        self._process: SpawnProcess | None = None
        self._warm: set[Reader] = set()

    def read(self, reader: Reader, path: Path, original: Path | None = None) -> Answer | Verdict:
        """Return the answer of a reader, or the verdict that it crashed or hangs.

        A new process reads the `original` first, so that imports do not count.
        """
        if self._process is None:
            self._start()
        if original is not None and reader not in self._warm:
            self._ask(reader, original, START_S)
            self._warm.add(reader)
        return self._ask(reader, path, START_S if original is None else self._limit_s)

    def _ask(self, reader: Reader, path: Path, limit_s: float) -> Answer | Verdict:
        limit_s = time_limit(limit_s)
        try:
            self._pipe.send((reader, path))
            if not self._pipe.poll(limit_s):
                self.close(0.0)
                return Verdict(Outcome.HANG, f'no answer within {limit_s:.0f} s')
            answer = self._pipe.recv()
        except (EOFError, OSError):
            return self._crashed()
        assert isinstance(answer, Answer)
        return answer

    def close(self, wait_s: float = END_S) -> None:
        """End the process, and kill it after `wait_s`."""
        if self._process is not None:
            self._pipe.close()
            self._process.join(wait_s)
            self._process.kill()
            self._process.join()
            self._process = None

    def _start(self) -> None:
        context = multiprocessing.get_context('spawn')
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, self._log), daemon=True)
        self._process.start()
        theirs.close()
        self._warm.clear()

    def _crashed(self) -> Verdict:
        assert self._process is not None
        self._process.join()
        code = self._process.exitcode or 0
        self.close()
        name = signal.Signals(-code).name if code < 0 else f'exit status {code}'
        return Verdict(Outcome.CRASH, f'{name}: {self._last_frame()}')

    def _last_frame(self) -> str:
        """Return the innermost frame of the last dump of faulthandler in the log."""
        lines = self._log.read_text('utf-8', 'replace').splitlines()[-100:]
        frames = [line.strip() for line in lines if line.startswith('  File ')]
        return (frames[0] if frames else lines[-1] if lines else 'nothing printed')[:MAX_REASON]


def serve(pipe: Connection, log: Path) -> None:
    """Answer requests until the pipe closes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.environ['TQDM_DISABLE'] = '1'
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(descriptor, stream.fileno())
    faulthandler.enable(sys.stderr)
    with contextlib.suppress(EOFError, OSError):
        while True:
            reader, path = pipe.recv()
            pipe.send(answer_of(reader, path))


def answer_of(reader: Reader, path: Path) -> Answer:
    """Return the answer of a reader, also where it raises."""
    try:
        return reader(path)
    except BaseException as error:  # SystemExit would end a command
        place = traceback.extract_tb(error.__traceback__)[-1]
        inner = [each for each in traceback.extract_tb(error.__traceback__)
                 if 'kfvo_ros' in each.filename][-1:] or [place]
        text = f'{type(error).__name__}: {error}'.replace('\n', ' ')[:MAX_REASON]
        return Answer(traceback=f'{text} at {Path(inner[0].filename).name}:{inner[0].lineno}')
