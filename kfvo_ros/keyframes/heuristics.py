# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe policies by rule."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy, ObservationLayout, indices_of
from kfvo_ros.tracking.tracker import common, mean_flow

MIN_TRACKS = 8
"""With fewer tracks left since the last keyframe their mean motion means nothing: keep."""
FLOW, BASELINE, SURVIVAL = 'flow', 'baseline_to_depth', 'track_survival'


class EveryFrame(KeyframePolicy):
    """Keep every frame: the paper's VGGT-SW."""

    name = 'every'

    def decide(self, decision: DecisionInput) -> bool:
        """Keep."""
        return True


class OpticalFlow(KeyframePolicy):
    """Keep once the tracks moved by more than `threshold` [px] on average: VGGT-LK."""

    name = 'optical_flow'
    needs_tracks = True

    def __init__(self, threshold: float = 50.0) -> None:
        self.threshold = threshold

    def decide(self, decision: DecisionInput) -> bool:
        """Compare the mean flow since the last keyframe with the threshold."""
        before, after = common(decision.keyframe_tracks, decision.newest_tracks)
        return len(before) < MIN_TRACKS or mean_flow(before, after) > self.threshold


class Survival(KeyframePolicy):
    """Keep once less than `share` of the last keyframe's tracks survive.

    Never below `min_flow` [px] of mean flow, so that a camera at rest adds no keyframes.
    """

    name = 'survival'
    needs_tracks = True

    def __init__(self, share: float = 0.8, min_flow: float = 2.0) -> None:
        self.share = share
        self.min_flow = min_flow

    def decide(self, decision: DecisionInput) -> bool:
        """Compare the share of surviving tracks with the threshold."""
        before, after = common(decision.keyframe_tracks, decision.newest_tracks)
        if len(before) < MIN_TRACKS:
            return True
        survived = len(before) / len(decision.keyframe_tracks)
        return survived < self.share and mean_flow(before, after) >= self.min_flow


@dataclass(frozen=True)
class ParallaxRule:
    """Keeps a frame after enough flow or baseline, or when too few of the tracks are left.

    ``flow`` is the tracks' mean motion since the last keyframe [px], ``baseline`` the camera's by
    the median depth, ``survival`` the share of that keyframe's tracks which must be left.
    """

    flow: float
    baseline: float
    survival: float

    @staticmethod
    def unseen_in(layout: ObservationLayout) -> list[str]:
        """Return the names of what a teacher looks at and an observation does not hold."""
        return [name for name in (FLOW, BASELINE, SURVIVAL) if (name, 1) not in layout]

    def decide(self, observations: np.ndarray, layout: ObservationLayout) -> np.ndarray:
        """Return 1 where it keeps, else 0, (N,) for observations (N, D) in this layout."""
        seen = indices_of(((FLOW, 1), (BASELINE, 1), (SURVIVAL, 1)), layout)
        flow, baseline, survival = observations[:, seen].T
        return ((flow > np.log1p(self.flow)) | (baseline > self.baseline)
                | (survival < self.survival)).astype(np.int64)
