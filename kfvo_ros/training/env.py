# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many episodes at once, for stable-baselines3: one call of the backbone steps all of them."""

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
    """Many episodes at once: they come and go, so there is nothing to get or set in them."""

    render_mode = None

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute, which all episodes share, for some of them."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse."""
        raise NotImplementedError('episodes have no attributes to set')

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None,
                   **method_kwargs: Any) -> list[Any]:
        """Refuse."""
        raise NotImplementedError('episodes have no methods to call')

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Tell that no episode is wrapped."""
        return [False for _ in self._get_indices(indices)]


class KeyframeEnvironment(EpisodeVecEnv):
    """Steps N episodes; where one ends, the next of the same source follows.

    `sources` give episodes for ever; `indices` say what is seen of an observation. What is
    observed and rewarded are decisions only: an episode is driven to its first one before
    anybody sees it, and one that ends without any is passed over. The end of an episode, of what
    was recorded or because the camera is lost, is not that of the world: it is told as
    truncation, with the last decision's observation for want of a later one. Observations are
    not standardised yet.
    """

    def __init__(self, backbone: Backbone, sources: Sequence[Iterator[Episode]],
                 indices: np.ndarray) -> None:
        self._backbone, self._sources, self._indices = backbone, list(sources), indices
        self._episodes: list[Episode] = []
        self._actions = np.zeros(len(sources), dtype=np.int64)
        self._observed: Observations = {}
        super().__init__(len(sources), spaces.Dict({
            OBSERVATION: spaces.Box(-np.inf, np.inf, (len(indices),), np.float32),
            PRIVILEGED: spaces.Box(-np.inf, np.inf, (PRIVILEGED_SIZE,), np.float32)}),
            spaces.Discrete(2))

    def reset(self) -> Observations:
        """Begin an episode of every source."""
        self._episodes = [next(source) for source in self._sources]
        self._drive_on()
        self._observed = self._observe()
        return self._observed

    def step_async(self, actions: np.ndarray) -> None:
        """Remember what is to be done."""
        self._actions = actions

    def step_wait(self) -> tuple[Observations, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Decide in every episode and drive on to the next decision of each."""
        last = self._observed
        decided = list(self._episodes)
        for episode, action in zip(decided, self._actions, strict=True):
            episode.decide(bool(action))
        self._drive_on()
        rewards = np.array([episode.take_reward() for episode in decided], dtype=np.float32)
        dones = np.array([now is not before for now, before in zip(self._episodes, decided)])
        infos: list[dict[str, Any]] = [
            {'terminal_observation': {name: values[number] for name, values in last.items()},
             'TimeLimit.truncated': True}
            if done else {} for number, done in enumerate(dones)]
        self._observed = self._observe()
        return self._observed, rewards, dones, infos

    def _drive_on(self) -> None:
        """Bring every episode to a decision, all that are not there in one call each time."""
        while True:
            for number, episode in enumerate(self._episodes):
                while episode.ended:
                    episode = self._episodes[number] = next(self._sources[number])
            driving = [episode for episode in self._episodes if episode.decision is None]
            if not driving:
                return
            unseen = [episode.unseen() for episode in driving]
            encoded = iter(self._backbone.encode([each for each in unseen if each is not None]))
            windows = [episode.enter(None if each is None else next(encoded))
                       for episode, each in zip(driving, unseen)]
            estimates = iter(self._backbone.estimate([w for w in windows if w is not None]))
            for episode, window in zip(driving, windows):
                episode.leave(None if window is None else next(estimates))

    def _observe(self) -> Observations:
        """Return what is seen of all episodes, (N, size) each."""
        decisions = [episode.decision for episode in self._episodes]
        return {OBSERVATION: np.stack([each.observation[self._indices] for each in decisions
                                       if each]),
                PRIVILEGED: np.stack([episode.privileged() for episode in self._episodes])}
