# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Environments in processes of their own, side by side as one."""

from __future__ import annotations

import contextlib
import multiprocessing
import time
from collections.abc import Callable, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from kfvo_ros.errors import KfvoError
from kfvo_ros.training.env import EpisodeVecEnv, Observations
from kfvo_ros.utils.process import signals_blocked, single_threaded

STEP, RESET, CLOSE = 'step', 'reset', 'close'
PATIENCE_S = 2.0
"""A process that is at a long sequence is not waited for: it has nothing that would be lost."""
GONE = 'a worker process ended; is there memory for fewer?'


class VecWorkers(EpisodeVecEnv):
    """Steps one environment per process, each of many episodes.

    stable-baselines3's own SubprocVecEnv has a process for every episode; here a step costs one
    message per process, and the processor is busy although episodes take unequally long.
    `makers` are called in the processes and must be picklable. What a process raises is raised
    here as KfvoError. SIGINT and SIGTERM, which reach all processes of a group, leave them alone:
    one has to clear up, and ends the others.
    """

    def __init__(self, makers: Sequence[Callable[[], VecEnv]]) -> None:
        self._pipes: list[Connection] = []
        self._processes: list[SpawnProcess] = []
        try:
            for maker in makers:
                self._start(maker)
            spaces = self._answers()
        except BaseException:
            self.close()
            raise
        self._counts = [count for count, _, _ in spaces]
        super().__init__(sum(self._counts), *spaces[0][1:])

    def reset(self) -> Observations:
        """Begin all episodes anew."""
        self._send(RESET, [None] * len(self._pipes))
        return _joined(self._answers())

    def step_async(self, actions: np.ndarray) -> None:
        """Set all processes to work."""
        self._send(STEP, np.split(actions, np.cumsum(self._counts)[:-1]))

    def step_wait(self) -> tuple[Observations, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Gather what they did."""
        observations, rewards, dones, infos = zip(*self._answers())
        return (_joined(observations), np.concatenate(rewards), np.concatenate(dones),
                [info for part in infos for info in part])

    def close(self) -> None:
        """End the processes."""
        until = time.monotonic() + PATIENCE_S
        try:
            for pipe in self._pipes:
                with contextlib.suppress(OSError):  # it may have ended already
                    pipe.send((CLOSE, None))
            for process in self._processes:
                process.join(max(0.0, until - time.monotonic()))
        finally:  # Python would wait at its exit for those that a second Ctrl-C left
            for pipe, process in zip(self._pipes, self._processes):
                process.kill()
                pipe.close()

    def _start(self, maker: Callable[[], VecEnv]) -> None:
        context = multiprocessing.get_context('spawn')
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, maker), daemon=True)
        resource_tracker.ensure_running()  # as it starts it lets signals through again
        with signals_blocked():  # the process inherits that, from before its first line
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)

    def _send(self, what: str, actions: Sequence[np.ndarray | None]) -> None:
        """Tell all processes what to do; raises KfvoError where one is gone."""
        for pipe, part in zip(self._pipes, actions, strict=True):
            try:
                pipe.send((what, part))
            except OSError as error:
                raise KfvoError(GONE) from error

    def _answers(self) -> list[Any]:
        """Wait for all processes; raises KfvoError for what one of them could not do."""
        answers = []
        for pipe in self._pipes:
            try:
                done, answer = pipe.recv()
            except (EOFError, OSError) as error:
                raise KfvoError(GONE) from error
            if not done:
                raise KfvoError(answer)
            answers.append(answer)
        return answers


def _joined(parts: Sequence[Observations]) -> Observations:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _serve(pipe: Connection, maker: Callable[[], VecEnv]) -> None:
    """Do what comes through the pipe until told to end, or until nobody is there any more."""
    with single_threaded(), contextlib.suppress(EOFError, ConnectionError):
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
