# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Environments in processes of their own, side by side as one."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from kfvo_ros.errors import KfvoError
from kfvo_ros.learning.environment import Episodes, Observations
from kfvo_ros.threads import single_threaded

STEP, RESET, CLOSE = 'step', 'reset', 'close'
PATIENCE_S = 2.0
"""A process that is at a long sequence is not waited for: it has nothing that would be lost."""


class Workers(Episodes):
    """Steps one environment per process, each of many episodes.

    stable-baselines3's own SubprocVecEnv has a process for every episode; here a step costs one
    message per process, and the processor is busy although episodes take unequally long.
    `makers` are called in the processes and must be picklable. What a process raises is raised
    here as KfvoError.
    """

    def __init__(self, makers: Sequence[Callable[[], VecEnv]]) -> None:
        context = multiprocessing.get_context('spawn')
        self._pipes: list[Connection] = []
        self._processes = []
        for maker in makers:
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, maker), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)
        spaces = self._answers()
        self._counts = [count for count, _, _ in spaces]
        super().__init__(sum(self._counts), *spaces[0][1:])

    def reset(self) -> Observations:
        """Begin all episodes anew."""
        for pipe in self._pipes:
            pipe.send((RESET, None))
        return _joined(self._answers())

    def step_async(self, actions: np.ndarray) -> None:
        """Set all processes to work."""
        parts = np.split(actions, np.cumsum(self._counts)[:-1])
        for pipe, part in zip(self._pipes, parts, strict=True):
            pipe.send((STEP, part))

    def step_wait(self) -> tuple[Observations, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Gather what they did."""
        observations, rewards, dones, infos = zip(*self._answers())
        return (_joined(observations), np.concatenate(rewards), np.concatenate(dones),
                [info for part in infos for info in part])

    def close(self) -> None:
        """End the processes."""
        for pipe, process in zip(self._pipes, self._processes):
            with contextlib.suppress(OSError):  # it may have ended already
                pipe.send((CLOSE, None))
            process.join(PATIENCE_S)
            process.terminate()
            pipe.close()

    def _answers(self) -> list[Any]:
        """Wait for all processes; raises KfvoError for what one of them could not do."""
        answers = []
        for pipe in self._pipes:
            try:
                done, answer = pipe.recv()
            except EOFError as error:
                raise KfvoError('a worker process ended; is there memory for fewer?') from error
            if not done:
                raise KfvoError(answer)
            answers.append(answer)
        return answers


def _joined(parts: Sequence[Observations]) -> Observations:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _serve(pipe: Connection, maker: Callable[[], VecEnv]) -> None:
    """Do what comes through the pipe until told to end, or until nobody is there any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; one has to clear up
    with single_threaded():
        try:
            environment = maker()
            pipe.send((True, (environment.num_envs, environment.observation_space,
                              environment.action_space)))
            while True:
                what, actions = pipe.recv()
                if what == CLOSE:
                    return
                pipe.send((True, environment.reset() if what == RESET
                           else environment.step(actions)))
        except KfvoError as error:
            pipe.send((False, str(error)))
        except EOFError:
            return
