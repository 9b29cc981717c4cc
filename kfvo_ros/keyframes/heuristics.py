# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe policies by rule."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros.keyframes.base import (
    MIN_TRACKS,
    DecisionInput,
    KeyframePolicy,
    ObservationLayout,
    indices_of,
)
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.tracking.tracker import common_pixels, mean_flow

FLOW, BASELINE, SURVIVAL = 'flow', 'baseline_to_depth', 'track_survival'
"""Signals of the backbone that the parallax rule compares."""


class EveryFrame(KeyframePolicy):
    """Keeps every frame: the paper's VGGT-SW."""

    name = 'every'

    def decide(self, decision: DecisionInput) -> bool:
        """Return True."""
        return True


class OpticalFlow(KeyframePolicy):
    """Keeps when the mean flow since the last keyframe exceeds `threshold` [px]: VGGT-LK."""

    name = 'optical_flow'
    needs_tracks = True

    def __init__(self, threshold: float = 50.0) -> None:
        self.threshold = threshold

    def decide(self, decision: DecisionInput) -> bool:
        """Compare the mean flow with the threshold; keep when too few tracks are left."""
        before, after = common_pixels(decision.keyframe_tracks, decision.newest_tracks)
        return len(before) < MIN_TRACKS or mean_flow(before, after) > self.threshold


class Survival(KeyframePolicy):
    """Keeps when less than `share` of the last keyframe's tracks survive.

    Below `min_flow` [px] of mean flow it drops, so that a camera at rest adds no keyframes.
    """

    name = 'survival'
    needs_tracks = True

    def __init__(self, share: float = 0.8, min_flow: float = 2.0) -> None:
        self.share = share
        self.min_flow = min_flow

    def decide(self, decision: DecisionInput) -> bool:
        """Compare survival and mean flow with the thresholds; keep when few tracks are left."""
        before, after = common_pixels(decision.keyframe_tracks, decision.newest_tracks)
        if len(before) < MIN_TRACKS:
            return True
        survival = len(before) / len(decision.keyframe_tracks)
        return survival < self.share and mean_flow(before, after) >= self.min_flow


@dataclass(frozen=True)
class ParallaxRule:
    """Keeps after enough flow or baseline, or when too few tracks survive.

    Since the last keyframe: ``flow`` is the mean flow of the tracks [px], ``baseline`` the camera
    motion over the median depth, ``survival`` the share of surviving tracks.
    """

    flow: float
    baseline: float
    survival: float

    @staticmethod
    def missing_signals(layout: ObservationLayout) -> list[str]:
        """Return the names of the signals that the rule compares and the layout does not hold."""
        return [name for name in (FLOW, BASELINE, SURVIVAL) if (name, 1) not in layout]

    def decide(self, observations: np.ndarray, layout: ObservationLayout) -> np.ndarray:
        """Return 1 to keep, 0 to drop: (N,) int64 for observations (N, D) of this layout."""
        columns = indices_of(((FLOW, 1), (BASELINE, 1), (SURVIVAL, 1)), layout)
        flow, baseline, survival = observations[:, columns].T
        return ((flow > np.log1p(self.flow)) | (baseline > self.baseline)
                | (survival < self.survival)).astype(np.int64)


PARALLAX_RULE = ParallaxRule(flow=50.0, baseline=0.02, survival=0.2)
PARALLAX_GUARD = KeyframeGuard(min_survival=0.15, max_gap=60, min_flow=2.0)
"""The rule that the learned policy imitates first, and the guard of both: config/train.yaml."""


class ParallaxPolicy(KeyframePolicy):
    """Decides by a `ParallaxRule` inside a `KeyframeGuard`, on observations of `layout`.

    The layout must hold the rule's signals; see `ParallaxRule.missing_signals`.
    """

    name = 'parallax'

    def __init__(self, layout: ObservationLayout, rule: ParallaxRule = PARALLAX_RULE,
                 guard: KeyframeGuard = PARALLAX_GUARD) -> None:
        self._layout, self._rule, self._guard = layout, rule, guard
        self.needs_tracks = guard.needs_tracks

    def decide(self, decision: DecisionInput) -> bool:
        """Return the guard's decision if it forces one, else that of the rule."""
        forced = self._guard.forced(decision)
        if forced is not None:
            return forced
        return bool(self._rule.decide(decision.observation[None], self._layout)[0])
