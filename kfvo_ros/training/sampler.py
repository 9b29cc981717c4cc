# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From names of sequences to episodes without end, and to an environment that steps them."""

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

LEAST_LEFT = 150
"""An episode begins anywhere but in so many last frames of a drive."""
MOST_UNASKED = 10
"""So many episodes in a row without a decision, and no sequence left out, are enough."""
EnvironmentSpec = tuple[tuple[str, ...], np.random.SeedSequence]
"""One episode at a time: the sequences it takes turns in, and its seed."""


@dataclass(frozen=True)
class EnvironmentConfig:
    """What is learned from, and how: all that a process needs to make episodes.

    ``tracks`` are followed per frame. A sequence has so many ``variants``, tracked once and kept
    in the folder ``cache``. ``seen`` are the parts of the observation that are told, None for
    all. ``reward`` is ``paper`` or ``local``, over ``span`` frames, and ``alpha`` what a keyframe
    is worth in it.
    """

    sequences: tuple[str, ...]
    reading: SequenceOptions = SequenceOptions()
    odometry: OdometryOptions = OdometryOptions()
    vggt: VggtOptions = VggtOptions()
    augmentation: Augmentation = Augmentation()
    variants: int = 2
    tracks: int = FEATURES
    reward: str = 'local'
    span: int = 1000
    alpha: float = 0.0
    rail: KeyframeGuard = KeyframeGuard()
    seen: ObservationLayout | None = None
    cache: Path | None = None

    def backbone(self) -> Backbone:
        """Return the backbone to learn with; raises KfvoError."""
        if self.odometry.backbone == 'geometric':
            from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
            return GeometricBackbone(self.odometry.seed, self.tracks)
        return factory.make_backbone(self.odometry, self.vggt)

    def archive(self, backbone: Backbone) -> EncodedSequenceCache:
        """Return where the drives come from: tracked once, or held as images to be encoded."""
        return EncodedSequenceCache(backbone, self.reading,
                                    {'seed': self.odometry.seed, 'tracks': self.tracks}, self.cache,
                                    live=not backbone.offers_tracks)

    def new_reward(self, frames: int) -> Reward:
        """Return the reward of one episode of so many frames."""
        if self.reward == 'paper':
            return PaperReward(self.alpha)
        return LocalReward(min(self.span, frames), self.alpha)


class EpisodeSampler:
    """One process's backbone and drives, and the episodes it makes of them."""

    def __init__(self, lesson: EnvironmentConfig) -> None:
        self._lesson = lesson
        self._backbone = lesson.backbone()
        self._present = factory.signature_of(lesson.odometry, self._backbone)
        self._archive = lesson.archive(self._backbone)

    def environment(self, pupils: Sequence[EnvironmentSpec]) -> KeyframeEnvironment:
        """Return an environment that steps one episode of each at a time."""
        everything = self._present.observation
        return KeyframeEnvironment(self._backbone, [self._episodes(*pupil) for pupil in pupils],
                                   indices_of(self._lesson.seen or everything, everything))

    def _episodes(self, sequences: tuple[str, ...],
                  seed: np.random.SeedSequence) -> Iterator[Episode]:
        """Yield episodes for ever: each sequence in turn, in a variant, from somewhere on.

        Raises KfvoError where they end again and again before there is anything to decide.
        """
        lesson, rng, unasked = self._lesson, np.random.default_rng(seed), 0
        while unasked < max(MOST_UNASKED, len(sequences)):
            for text in rng.permutation(sequences):
                drive = self._archive.variant(str(text), lesson.augmentation,
                                              int(rng.integers(lesson.variants)))
                start = int(rng.integers(max(1, len(drive) - LEAST_LEFT)))
                episode = Episode(drive.since(start), self._backbone, self._present.scale_rule,
                                  self._present.window_size, lesson.rail,
                                  lesson.new_reward(len(drive) - start))
                yield episode
                unasked = 0 if episode.asked else unasked + 1
        raise KfvoError(f'{", ".join(sequences)}: expected decisions to learn from, there were '
                        f'none in {unasked} episodes: the camera is lost or at rest, or the rail '
                        'decides all')


def make_environment(lesson: EnvironmentConfig, environments: int, workers: int, seed: int) -> VecEnv:
    """Return so many episodes at once, stepped by so many processes; raises KfvoError.

    How many workers there are changes nothing but the time; one is this process itself. What
    cannot be learned from, because nobody knows where its camera was, is refused at once.
    """
    for text in lesson.sequences:
        true_trajectory(factory.make_sequence(text, lesson.reading))
    seeds = np.random.SeedSequence(seed).spawn(environments)
    count = len(lesson.sequences)
    pupils: list[EnvironmentSpec] = [(lesson.sequences[number % count::environments], seeds[number])
                                     for number in range(environments)]
    classes = [pupils[part[0]:part[-1] + 1]
               for part in np.array_split(np.arange(environments), min(workers, environments))]
    if len(classes) == 1:
        return EpisodeSampler(lesson).environment(pupils)
    return VecWorkers([partial(_open, lesson, each) for each in classes])


def _open(lesson: EnvironmentConfig, pupils: list[EnvironmentSpec]) -> KeyframeEnvironment:
    return EpisodeSampler(lesson).environment(pupils)
