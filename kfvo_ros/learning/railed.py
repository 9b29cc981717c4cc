# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Policies that learned nothing, inside the rail of those that did: what did learning add?"""

from __future__ import annotations

import numpy as np

from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy
from kfvo_ros.keyframes.observation import Layout
from kfvo_ros.keyframes.rail import Rail
from kfvo_ros.learning.teacher import Teacher


class RailAlone(KeyframePolicy):
    """Drops every frame that the rail does not keep."""

    name = 'rail'

    def __init__(self, rail: Rail) -> None:
        self._rail = rail
        self.needs_tracks = rail.needs_tracks

    def decide(self, decision: DecisionInput) -> bool:
        """Ask the rail, and drop where it does not care."""
        return bool(self._rail.forced(decision))


class Random(KeyframePolicy):
    """Keeps every second frame, by chance, of those that the rail leaves open."""

    name = 'random'

    def __init__(self, rail: Rail, seed: int) -> None:
        self._rail = rail
        self.needs_tracks = rail.needs_tracks
        self._rng = np.random.default_rng(seed)

    def decide(self, decision: DecisionInput) -> bool:
        """Ask the rail, then chance."""
        forced = self._rail.forced(decision)
        return forced if forced is not None else bool(self._rng.integers(2))


class Taught(KeyframePolicy):
    """Does what a teacher would, of observations in a `layout`, where the rail leaves it open."""

    name = 'teacher'

    def __init__(self, rail: Rail, teacher: Teacher, layout: Layout) -> None:
        self._rail, self._teacher, self._layout = rail, teacher, layout
        self.needs_tracks = rail.needs_tracks

    def decide(self, decision: DecisionInput) -> bool:
        """Ask the rail, then the teacher."""
        forced = self._rail.forced(decision)
        return forced if forced is not None else bool(
            self._teacher.decide(decision.observation[None], self._layout)[0])
