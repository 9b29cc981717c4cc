# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe selection as a vectorised environment of stable-baselines3.

One call of the backbone steps all episodes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.training.episode import PRIVILEGED_SIZE, Episode

OBSERVATION, PRIVILEGED = 'observation', 'privileged'
Observations = dict[str, np.ndarray]


class EpisodeVecEnv(VecEnv):
    """Base of environments whose episodes have no attributes or methods of their own."""

    render_mode = None

    def close(self) -> None:
        """Do nothing: no resource is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment, once per index."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise NotImplementedError."""
        raise NotImplementedError('episodes have no attributes to set')

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None,
                   **method_kwargs: Any) -> list[Any]:
        """Raise NotImplementedError."""
        raise NotImplementedError('episodes have no methods to call')

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False, once per index."""
        return [False for _ in self._get_indices(indices)]


class KeyframeEnvironment(EpisodeVecEnv):
    """Steps N episodes; when one ends, the next of the same source follows.

    `sources` are endless iterators of episodes; `indices` select the visible numbers of an
    observation. Only decisions are observed and rewarded: an episode is advanced to its first
    decision before it is observed, and one without a decision is skipped. An episode ends with
    its recording or with a lost camera, neither of which is a terminal state: it is reported as
    a truncation, with the observation of the last decision. Observations are not standardised.
    """

    def __init__(self, backbone: Backbone, sources: Sequence[Iterator[Episode]],
                 indices: np.ndarray) -> None:
        self._backbone, self._sources, self._indices = backbone, list(sources), indices
        self._episodes: list[Episode] = []
        self._actions = np.zeros(len(sources), dtype=np.int64)
        self._observations: Observations = {}
        super().__init__(len(sources), spaces.Dict({
            OBSERVATION: spaces.Box(-np.inf, np.inf, (len(indices),), np.float32),
            PRIVILEGED: spaces.Box(-np.inf, np.inf, (PRIVILEGED_SIZE,), np.float32)}),
            spaces.Discrete(2))

    def reset(self) -> Observations:
        """Start an episode of every source; return the first observations."""
        self._episodes = [next(source) for source in self._sources]
        self._advance()
        self._observations = self._observe()
        return self._observations

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (N,) of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Observations, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Apply the actions and advance every episode to its next decision."""
        last = self._observations
        acted = list(self._episodes)
        for episode, action in zip(acted, self._actions, strict=True):
            episode.decide(bool(action))
        self._advance()
        rewards = np.array([episode.pop_reward() for episode in acted], dtype=np.float32)
        dones = np.array([now is not before for now, before in zip(self._episodes, acted)])
        infos: list[dict[str, Any]] = [
            {'terminal_observation': {name: values[index] for name, values in last.items()},
             'TimeLimit.truncated': True}
            if done else {} for index, done in enumerate(dones)]
        self._observations = self._observe()
        return self._observations, rewards, dones, infos

    def _advance(self) -> None:
        """Advance every episode to a decision, one batched backbone call per frame."""
        while True:
            for index, episode in enumerate(self._episodes):
                while episode.ended:
                    episode = self._episodes[index] = next(self._sources[index])
            waiting = [episode for episode in self._episodes if episode.decision is None]
            if not waiting:
                return
            unencoded = [episode.unencoded_frame() for episode in waiting]
            encoded = iter(self._backbone.encode([each for each in unencoded
                                                  if each is not None]))
            windows = [episode.begin(None if each is None else next(encoded))
                       for episode, each in zip(waiting, unencoded)]
            estimates = iter(self._backbone.estimate([w for w in windows if w is not None]))
            for episode, window in zip(waiting, windows):
                episode.integrate(None if window is None else next(estimates))

    def _observe(self) -> Observations:
        """Return the observations of all episodes, (N, size) each."""
        decisions = [episode.decision for episode in self._episodes]
        return {OBSERVATION: np.stack([each.observation[self._indices] for each in decisions
                                       if each]),
                PRIVILEGED: np.stack([episode.privileged_observation()
                                      for episode in self._episodes])}
