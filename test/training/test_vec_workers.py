# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Environments in worker processes: signals, errors and their end."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from multiprocessing import resource_tracker

import numpy as np
import pytest
from command_lines import children_of, is_running, started

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from gymnasium import spaces

from kfvo_ros.errors import KfvoError
from kfvo_ros.training.env import OBSERVATION, EpisodeVecEnv
from kfvo_ros.training.vec_workers import STEP, VecWorkers, _serve
from kfvo_ros.utils.process import time_limit
from kfvo_ros.utils.signals import SIGNALS, Interrupted

OBSERVATIONS = {OBSERVATION: np.zeros((1, 2), np.float32)}


class StaticEnvironment(EpisodeVecEnv):
    """One episode with constant observations."""

    def __init__(self) -> None:
        super().__init__(1, spaces.Dict({OBSERVATION: spaces.Box(-1.0, 1.0, (2,))}),
                         spaces.Discrete(2))

    def reset(self):
        return OBSERVATIONS

    def step_async(self, actions):
        pass

    def step_wait(self):
        return OBSERVATIONS, np.zeros(1, np.float32), np.zeros(1, bool), [{}]


class InterruptedMaker:
    """Makes a StaticEnvironment; signals arrive while the worker unpickles this."""

    def __setstate__(self, state) -> None:
        for number in SIGNALS:
            os.kill(os.getpid(), number)

    def __getstate__(self):
        return {'not': 'empty'}

    def __call__(self) -> StaticEnvironment:
        return StaticEnvironment()


def failing_maker() -> StaticEnvironment:
    raise KfvoError('expected more, less came')


def test_workers_ignore_signals_to_all_processes():
    resource_tracker._resource_tracker._stop()  # as in a process that begins
    environment = VecWorkers([InterruptedMaker(), InterruptedMaker()])
    try:
        environment.reset()
        for number in SIGNALS:
            for process in environment._processes:
                os.kill(process.pid, number)
            observations, *_ = environment.step(np.zeros(2, np.int64))
            assert observations[OBSERVATION].shape == (2, 2)
        assert not set(SIGNALS) & signal.pthread_sigmask(signal.SIG_BLOCK, ())
    finally:
        environment.close()
    for process in environment._processes:
        process.join(30.0)
        assert not process.is_alive()


def test_a_worker_that_ended_is_one_clear_line():
    environment = VecWorkers([StaticEnvironment, StaticEnvironment])
    last = environment._processes[-1]
    try:
        os.kill(last.pid, signal.SIGSTOP)  # messages stay unread
        environment.step_async(np.zeros(2, np.int64))
        last.kill()
        with pytest.raises(KfvoError, match='^a worker process ended; is there memory for fewer'):
            environment.step_wait()
        for begin in (environment.reset, lambda: environment.step_async(np.zeros(2, np.int64))):
            with pytest.raises(KfvoError, match='^a worker process ended'):
                begin()
    finally:
        environment.close()


def test_if_one_worker_fails_to_start_all_end():
    with pytest.raises(KfvoError) as refusal:
        VecWorkers([StaticEnvironment, failing_maker])
    for process in multiprocessing.active_children():
        process.join(10.0)
        assert not process.is_alive()
    assert str(refusal.value) == 'expected more, less came'  # its traceback holds the workers


def test_a_signal_while_closing_leaves_no_worker(monkeypatch):
    environment = VecWorkers([StaticEnvironment])
    process, = environment._processes
    os.kill(process.pid, signal.SIGSTOP)  # as in the middle of a long sequence

    def interrupt(timeout: float) -> None:
        raise Interrupted

    try:
        with monkeypatch.context() as patch, pytest.raises(Interrupted):
            patch.setattr(process, 'join', interrupt)
            environment.close()
        process.join(10.0)
        assert process.exitcode == -signal.SIGKILL
    finally:
        process.kill()


def test_a_worker_ends_quietly_with_its_pipe():
    ours, theirs = multiprocessing.Pipe()

    class ClosingEnvironment(StaticEnvironment):
        def step_wait(self):
            ours.close()
            return super().step_wait()

    ours.send((STEP, np.zeros(1)))
    _serve(theirs, ClosingEnvironment)
    assert ours.closed


BUSY = """
import sys
import time

from kfvo_ros.training.vec_workers import VecWorkers


def make():
    print('busy', flush=True)
    time.sleep(600.0)


if __name__ == '__main__':
    VecWorkers([make])
"""


def test_a_busy_worker_ends_with_its_killed_parent(tmp_path):
    script = tmp_path / 'busy.py'
    script.write_text(BUSY)
    with started(script) as parent:
        assert parent.stdout.readline() == 'busy\n'
        children = children_of(parent.pid)  # the worker, and the resource tracker
        assert children
        parent.kill()
        parent.wait()
        end = time.monotonic() + time_limit(60.0)
        while any(map(is_running, children)):
            assert time.monotonic() < end
            time.sleep(0.02)
