# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Environments in worker processes, stepped side by side as one."""

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
from kfvo_ros.utils.children import end_with_parent
from kfvo_ros.utils.process import single_threaded
from kfvo_ros.utils.signals import signals_blocked

STEP, RESET, CLOSE = 'step', 'reset', 'close'
JOIN_TIMEOUT_S = 2.0
"""A worker in the middle of a long sequence is killed: it holds nothing that could be lost."""
WORKER_ENDED = 'a worker process ended; is there memory for fewer?'


class VecWorkers(EpisodeVecEnv):
    """Steps one environment of many episodes per worker process.

    SubprocVecEnv of stable-baselines3 has a process per episode; here a step costs one message
    per process, and the processor is busy although episodes take unequally long. `makers` are
    called in the workers and must be picklable. Errors of a worker are raised here as KfvoError.
    Workers block SIGINT and SIGTERM, which reach all processes of a group: this process handles
    them and ends the workers.
    """

    def __init__(self, makers: Sequence[Callable[[], VecEnv]]) -> None:
        self._pipes: list[Connection] = []
        self._processes: list[SpawnProcess] = []
        try:
            for maker in makers:
                self._start(maker)
            spaces = self._receive()
        except BaseException:
            self.close()
            raise
        self._counts = [count for count, _, _ in spaces]
        super().__init__(sum(self._counts), *spaces[0][1:])

    def reset(self) -> Observations:
        """Restart all episodes; return the first observations."""
        self._send(RESET, [None] * len(self._pipes))
        return _concatenate(self._receive())

    def step_async(self, actions: np.ndarray) -> None:
        """Send the actions (N,) to the workers."""
        self._send(STEP, np.split(actions, np.cumsum(self._counts)[:-1]))

    def step_wait(self) -> tuple[Observations, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Receive the results of the step from all workers."""
        observations, rewards, dones, infos = zip(*self._receive())
        return (_concatenate(observations), np.concatenate(rewards), np.concatenate(dones),
                [info for part in infos for info in part])

    def close(self) -> None:
        """End the workers."""
        deadline = time.monotonic() + JOIN_TIMEOUT_S
        try:
            for pipe in self._pipes:
                with contextlib.suppress(OSError):  # the worker may have ended already
                    pipe.send((CLOSE, None))
            for process in self._processes:
                process.join(max(0.0, deadline - time.monotonic()))
        finally:  # after a second Ctrl-C Python would wait for the others at its exit
            for pipe, process in zip(self._pipes, self._processes):
                process.kill()
                pipe.close()

    def _start(self, maker: Callable[[], VecEnv]) -> None:
        context = multiprocessing.get_context('spawn')
        pipe, worker_pipe = context.Pipe()
        process = context.Process(target=_serve, args=(worker_pipe, maker), daemon=True)
        resource_tracker.ensure_running()  # its start unblocks signals
        with signals_blocked():  # the worker inherits the mask, from before its first line
            process.start()
            worker_pipe.close()
            self._pipes.append(pipe)
            self._processes.append(process)

    def _send(self, command: str, actions: Sequence[np.ndarray | None]) -> None:
        """Send a command to all workers; raises KfvoError where one has ended."""
        for pipe, part in zip(self._pipes, actions, strict=True):
            try:
                pipe.send((command, part))
            except OSError as error:
                raise KfvoError(WORKER_ENDED) from error

    def _receive(self) -> list[Any]:
        """Return the results of all workers; raises KfvoError for an error in one of them."""
        results = []
        for pipe in self._pipes:
            try:
                succeeded, result = pipe.recv()
            except (EOFError, OSError) as error:
                raise KfvoError(WORKER_ENDED) from error
            if not succeeded:
                raise KfvoError(result)
            results.append(result)
        return results


def _concatenate(parts: Sequence[Observations]) -> Observations:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _serve(pipe: Connection, maker: Callable[[], VecEnv]) -> None:
    """Execute the commands from the pipe until CLOSE, or until the other end is closed."""
    parent = multiprocessing.parent_process()
    if parent is not None:  # which may be killed during a long step
        end_with_parent(parent.join)
    with single_threaded(), contextlib.suppress(EOFError, ConnectionError):
        try:
            environment = maker()
            pipe.send((True, (environment.num_envs, environment.observation_space,
                              environment.action_space)))
            while True:
                command, actions = pipe.recv()
                if command == CLOSE:
                    return
                pipe.send((True, environment.reset() if command == RESET
                           else environment.step(actions)))
        except KfvoError as error:
            pipe.send((False, str(error)))
