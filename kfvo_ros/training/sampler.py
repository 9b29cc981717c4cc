# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Endless episodes of sequences, and the environments that step them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import ObservationLayout, indices_of
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.tracking.tracker import FEATURES
from kfvo_ros.training.augmentation import Augmentation
from kfvo_ros.training.encoded_sequence import true_trajectory
from kfvo_ros.training.env import KeyframeEnvironment
from kfvo_ros.training.episode import Episode
from kfvo_ros.training.rewards import LocalReward, PaperReward, Reward
from kfvo_ros.training.sequence_cache import EncodedSequenceCache
from kfvo_ros.training.vec_workers import VecWorkers

MIN_EPISODE_FRAMES = 150
"""Frames that are left where an episode starts; a shorter sequence is run as a whole."""
MAX_EMPTY_EPISODES = 10
"""Episodes in a row without a decision, or one of each sequence if these are more."""
EnvironmentSpec = tuple[tuple[str, ...], np.random.SeedSequence]
"""The sequences of one source of episodes, and its seed."""


@dataclass(frozen=True)
class EnvironmentConfig:
    """Everything that a process needs to make episodes.

    ``tracks`` per frame are those of the geometric backbone. Each sequence has ``variants``
    augmented versions, encoded once and stored in the folder ``cache``. ``observation`` are the
    parts that the policy sees, None for all. ``reward`` is ``paper`` or ``local``, over ``span``
    frames, with ``alpha`` for a keyframe.
    """

    sequences: tuple[str, ...]
    sequence_options: SequenceOptions = SequenceOptions()
    odometry: OdometryOptions = OdometryOptions()
    vggt: VggtOptions = VggtOptions()
    augmentation: Augmentation = Augmentation()
    variants: int = 2
    tracks: int = FEATURES
    reward: str = 'local'
    span: int = 1000
    alpha: float = 0.0
    guard: KeyframeGuard = KeyframeGuard()
    observation: ObservationLayout | None = None
    cache: Path | None = None

    def make_backbone(self) -> Backbone:
        """Return the backbone of the episodes; raises KfvoError."""
        if self.odometry.backbone == 'geometric':
            from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
            return GeometricBackbone(self.odometry.seed, self.tracks)
        return factory.make_backbone(self.odometry, self.vggt)

    def sequence_cache(self, backbone: Backbone) -> EncodedSequenceCache:
        """Return the source of sequences; those of a backbone without tracks keep images."""
        return EncodedSequenceCache(backbone, self.sequence_options,
                                    {'seed': self.odometry.seed, 'tracks': self.tracks},
                                    self.cache, keep_images=not backbone.offers_tracks)

    def make_reward(self, frames: int) -> Reward:
        """Return the reward of one episode with this many frames."""
        if self.reward == 'paper':
            return PaperReward(self.alpha)
        return LocalReward(min(self.span, frames), self.alpha)


class EpisodeSampler:
    """Samples episodes with one backbone and one sequence cache, in one process."""

    def __init__(self, config: EnvironmentConfig) -> None:
        self._config = config
        self._backbone = config.make_backbone()
        self._signature = factory.signature_of(config.odometry, self._backbone)
        self._cache = config.sequence_cache(self._backbone)

    def environment(self, specs: Sequence[EnvironmentSpec]) -> KeyframeEnvironment:
        """Return an environment that steps one episode of each spec at a time."""
        layout = self._signature.observation
        return KeyframeEnvironment(self._backbone, [self._episodes(*spec) for spec in specs],
                                   indices_of(self._config.observation or layout, layout))

    def _episodes(self, sequences: tuple[str, ...],
                  seed: np.random.SeedSequence) -> Iterator[Episode]:
        """Yield episodes without end: all sequences in random order, variant and start frame.

        Raises KfvoError when too many episodes in a row have no decision.
        """
        config, rng, empty = self._config, np.random.default_rng(seed), 0
        while empty < max(MAX_EMPTY_EPISODES, len(sequences)):
            for text in rng.permutation(sequences):
                sequence = self._cache.variant(str(text), config.augmentation,
                                               int(rng.integers(config.variants)))
                start = int(rng.integers(max(1, len(sequence) - MIN_EPISODE_FRAMES)))
                episode = Episode(sequence.from_frame(start), self._backbone,
                                  self._signature.scale_rule, self._signature.window_size,
                                  config.guard, config.make_reward(len(sequence) - start))
                yield episode
                empty = 0 if episode.reached_decision else empty + 1
        raise KfvoError(f'{", ".join(sequences)}: expected decisions to learn from, there were '
                        f'none in {empty} episodes: the camera is lost or at rest, or the rail '
                        'forces every decision')


def make_environment(config: EnvironmentConfig, environments: int, workers: int,
                     seed: int) -> VecEnv:
    """Return an environment of this many episodes, stepped by this many processes.

    The number of workers changes nothing but the time; one worker is this process itself.
    Raises KfvoError at once for a sequence without true camera poses.
    """
    for text in config.sequences:
        true_trajectory(factory.make_sequence(text, config.sequence_options))
    seeds = np.random.SeedSequence(seed).spawn(environments)
    count = len(config.sequences)
    specs: list[EnvironmentSpec] = [(config.sequences[index % count::environments], seeds[index])
                                    for index in range(environments)]
    parts = [specs[part[0]:part[-1] + 1]
             for part in np.array_split(np.arange(environments), min(workers, environments))]
    if len(parts) == 1:
        return EpisodeSampler(config).environment(specs)
    return VecWorkers([partial(_sample, config, part) for part in parts])


def _sample(config: EnvironmentConfig, specs: list[EnvironmentSpec]) -> KeyframeEnvironment:
    return EpisodeSampler(config).environment(specs)
