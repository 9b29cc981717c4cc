# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe policies by rule."""

from __future__ import annotations

from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy
from kfvo_ros.tracking import common, mean_flow

MIN_TRACKS = 8
"""With fewer tracks left since the last keyframe their mean motion means nothing: keep."""


class Every(KeyframePolicy):
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
