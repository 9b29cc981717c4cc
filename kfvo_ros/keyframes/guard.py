# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decisions that are no decisions: what every keyframe policy would do at the extremes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from kfvo_ros.keyframes.base import DecisionInput
from kfvo_ros.keyframes.heuristics import MIN_TRACKS
from kfvo_ros.tracking.tracker import common, mean_flow


@dataclass(frozen=True)
class KeyframeGuard:
    """Keeps a frame when the last keyframe is nearly out of sight, drops one at rest.

    `min_survival`, the share of the last keyframe's tracks that must be left, and `max_gap`,
    the input frames since then, force to keep; less than `min_flow` [px] of mean motion since
    then forces to drop, and too few tracks to tell the motion to keep; zero, or None for the
    gap, forces nothing. Without tracks only the gap counts. It is part of a learned policy: one
    that was trained inside it knows nothing of what is outside. Raises ValueError for values out
    of range.
    """

    min_survival: float = 0.5
    max_gap: int | None = 40
    min_flow: float = 2.0

    def __post_init__(self) -> None:
        if not (0.0 <= self.min_survival <= 1.0 and 0.0 <= self.min_flow < float('inf')
                and (self.max_gap is None or self.max_gap >= 1)):
            raise ValueError('expected a min_survival of 0 to 1, a max_gap of at least 1 and a '
                             f'min_flow of at least 0; came {self}')

    @property
    def needs_tracks(self) -> bool:
        """Whether it asks how far the tracks moved, or how many are left."""
        return self.min_survival > 0.0 or self.min_flow > 0.0

    def without_tracks(self) -> KeyframeGuard:
        """Return what is left of it where nothing is tracked."""
        return replace(self, min_survival=0.0, min_flow=0.0)

    def forced(self, decision: DecisionInput) -> bool | None:
        """Return the decision where there is only one, else None."""
        if self.max_gap is not None and decision.gap >= self.max_gap:
            return True
        if not self.needs_tracks or len(decision.keyframe_tracks) == 0:
            return None
        before, after = common(decision.keyframe_tracks, decision.newest_tracks)
        if len(before) < max(MIN_TRACKS, self.min_survival * len(decision.keyframe_tracks)):
            return True
        return False if mean_flow(before, after) < self.min_flow else None


NO_GUARD = KeyframeGuard(min_survival=0.0, max_gap=None, min_flow=0.0)
