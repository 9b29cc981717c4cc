# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Environments in processes of their own: what ends them, and what does not."""

from __future__ import annotations

import multiprocessing
import os
import signal
from multiprocessing import resource_tracker

import numpy as np
import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from gymnasium import spaces

from kfvo_ros.errors import KfvoError
from kfvo_ros.training.env import OBSERVATION, EpisodeVecEnv
from kfvo_ros.training.vec_workers import STEP, VecWorkers, _serve
from kfvo_ros.utils.process import SIGNALS, Interrupted

SEEN = {OBSERVATION: np.zeros((1, 2), np.float32)}


class Still(EpisodeVecEnv):
    """One episode in which nothing happens."""

    def __init__(self) -> None:
        super().__init__(1, spaces.Dict({OBSERVATION: spaces.Box(-1.0, 1.0, (2,))}),
                         spaces.Discrete(2))

    def reset(self):
        return SEEN

    def step_async(self, actions):
        pass

    def step_wait(self):
        return SEEN, np.zeros(1, np.float32), np.zeros(1, bool), [{}]


class Disturbed:
    """Makes such an environment; Ctrl-C comes as early as it arrives in the process."""

    def __setstate__(self, state) -> None:
        for number in SIGNALS:
            os.kill(os.getpid(), number)

    def __getstate__(self):
        return {'not': 'empty'}

    def __call__(self) -> Still:
        return Still()


def unable() -> Still:
    raise KfvoError('expected more, less came')


def test_signals_to_all_processes_leave_workers_alone():
    resource_tracker._resource_tracker._stop()  # as in a process that begins
    environment = VecWorkers([Disturbed(), Disturbed()])
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


def test_a_worker_that_is_gone_is_one_clear_line():
    environment = VecWorkers([Still, Still])
    last = environment._processes[-1]
    try:
        os.kill(last.pid, signal.SIGSTOP)  # what comes stays unread
        environment.step_async(np.zeros(2, np.int64))
        last.kill()
        with pytest.raises(KfvoError, match='^a worker process ended; is there memory for fewer'):
            environment.step_wait()
        for begin in (environment.reset, lambda: environment.step_async(np.zeros(2, np.int64))):
            with pytest.raises(KfvoError, match='^a worker process ended'):
                begin()
    finally:
        environment.close()


def test_where_one_cannot_begin_all_end():
    with pytest.raises(KfvoError) as refusal:
        VecWorkers([Still, unable])
    for process in multiprocessing.active_children():
        process.join(10.0)
        assert not process.is_alive()
    assert str(refusal.value) == 'expected more, less came'  # which holds all that was begun


def test_none_is_left_by_an_impatient_signal(monkeypatch):
    environment = VecWorkers([Still])
    process, = environment._processes
    os.kill(process.pid, signal.SIGSTOP)  # as one at a long sequence

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


def test_a_worker_that_nobody_waits_for_ends_quietly():
    ours, theirs = multiprocessing.Pipe()

    class Orphaned(Still):
        def step_wait(self):
            ours.close()
            return super().step_wait()

    ours.send((STEP, np.zeros(1)))
    _serve(theirs, Orphaned)
    assert ours.closed
