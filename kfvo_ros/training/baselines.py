# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Policies that learned nothing, inside the rail of those that did: what did learning add?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.keyframes import HEURISTICS
from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy, ObservationLayout
from kfvo_ros.keyframes.guard import NO_GUARD, KeyframeGuard
from kfvo_ros.keyframes.heuristics import ParallaxRule
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.training.config import TrainingConfig


class GuardOnly(KeyframePolicy):
    """Drops every frame that the rail does not keep."""

    name = 'rail'

    def __init__(self, rail: KeyframeGuard) -> None:
        self._rail = rail
        self.needs_tracks = rail.needs_tracks

    def decide(self, decision: DecisionInput) -> bool:
        """Ask the rail, and drop where it does not care."""
        return bool(self._rail.forced(decision))


class RandomPolicy(KeyframePolicy):
    """Keeps every second frame, by chance, of those that the rail leaves open."""

    name = 'random'

    def __init__(self, rail: KeyframeGuard, seed: int) -> None:
        self._rail = rail
        self.needs_tracks = rail.needs_tracks
        self._rng = np.random.default_rng(seed)

    def decide(self, decision: DecisionInput) -> bool:
        """Ask the rail, then chance."""
        forced = self._rail.forced(decision)
        return forced if forced is not None else bool(self._rng.integers(2))


class ExpertPolicy(KeyframePolicy):
    """Does what a teacher would, of observations in a `layout`, where the rail leaves it open."""

    name = 'teacher'

    def __init__(self, rail: KeyframeGuard, teacher: ParallaxRule, layout: ObservationLayout) -> None:
        self._rail, self._teacher, self._layout = rail, teacher, layout
        self.needs_tracks = rail.needs_tracks

    def decide(self, decision: DecisionInput) -> bool:
        """Ask the rail, then the teacher."""
        forced = self._rail.forced(decision)
        return forced if forced is not None else bool(
            self._teacher.decide(decision.observation[None], self._layout)[0])


def reference_policies(recipe: TrainingConfig, options: OdometryOptions,
                       backbone: Backbone) -> dict[str, KeyframePolicy]:
    """Return the heuristics, and the recipe's teacher inside its rail, by their names."""
    policies = {name: factory.make_policy(replace(options, keyframes=name), backbone)
                for name in HEURISTICS}
    if recipe.teacher is not None:
        policies[ExpertPolicy.name] = ExpertPolicy(recipe.rail or NO_GUARD, recipe.teacher,
                                                   factory.signature_of(options, backbone).observation)
    return policies
