# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Forced decisions at the extremes, before a policy is asked."""

from __future__ import annotations

from dataclasses import dataclass, replace

from kfvo_ros.keyframes.base import MIN_TRACKS, DecisionInput
from kfvo_ros.tracking.tracker import common_pixels, mean_flow


@dataclass(frozen=True)
class KeyframeGuard:
    """Keeps a frame before the tracks of the last keyframe are lost; drops frames at standstill.

    In this order: a gap of ``max_gap`` input frames keeps, None for no limit; a share of the last
    keyframe's tracks below ``min_survival``, or fewer than MIN_TRACKS of them, keeps; mean flow
    since the last keyframe below ``min_flow`` [px] drops. Zero in both disables the tests of the
    tracks; without tracks only the gap counts. A learned policy is trained and used inside the
    same guard. Raises ValueError for values out of range.
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
        """Whether survival or flow is tested."""
        return self.min_survival > 0.0 or self.min_flow > 0.0

    def without_tracks(self) -> KeyframeGuard:
        """Return the guard for a backbone without tracks, which tests the gap only."""
        return replace(self, min_survival=0.0, min_flow=0.0)

    def forced(self, decision: DecisionInput) -> bool | None:
        """Return the forced decision, None where the policy decides."""
        if self.max_gap is not None and decision.gap >= self.max_gap:
            return True
        if not self.needs_tracks or len(decision.keyframe_tracks) == 0:
            return None
        before, after = common_pixels(decision.keyframe_tracks, decision.newest_tracks)
        if len(before) < max(MIN_TRACKS, self.min_survival * len(decision.keyframe_tracks)):
            return True
        return False if mean_flow(before, after) < self.min_flow else None


NO_GUARD = KeyframeGuard(min_survival=0.0, max_gap=None, min_flow=0.0)
"""Forces nothing."""
