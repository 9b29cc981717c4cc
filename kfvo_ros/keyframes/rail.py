# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decisions that are no decisions: what every keyframe policy would do at the extremes."""

from __future__ import annotations

from dataclasses import dataclass

from kfvo_ros.keyframes.base import DecisionInput
from kfvo_ros.keyframes.heuristics import MIN_TRACKS, mean_flow
from kfvo_ros.tracking import common


@dataclass(frozen=True)
class Rail:
    """Keeps a frame when the last keyframe is nearly out of sight, drops one at rest.

    `min_survival`, the share of the last keyframe's tracks that must be left, and `max_gap`,
    the input frames since then, force to keep; less than `min_flow` [px] of mean motion since
    then forces to drop. Without tracks only the gap counts. It is part of a learned policy: a
    policy that was trained inside it knows nothing of what is outside.
    """

    min_survival: float = 0.5
    max_gap: int = 40
    min_flow: float = 2.0

    def forced(self, decision: DecisionInput) -> bool | None:
        """Return the decision where there is only one, else None."""
        if decision.gap >= self.max_gap:
            return True
        if len(decision.keyframe_tracks) == 0:
            return None
        before, after = common(decision.keyframe_tracks, decision.newest_tracks)
        if len(before) < max(MIN_TRACKS, self.min_survival * len(decision.keyframe_tracks)):
            return True
        return False if mean_flow(before, after) < self.min_flow else None
