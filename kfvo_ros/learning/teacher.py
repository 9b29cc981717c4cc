# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A rule on the backbone's signals that is worth imitating before learning what is better."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros.keyframes.observation import Layout, indices_of

FLOW, BASELINE, SURVIVAL = 'flow', 'baseline_to_depth', 'track_survival'


@dataclass(frozen=True)
class Teacher:
    """Keeps a frame after enough flow or baseline, or when too few of the tracks are left.

    ``flow`` is the tracks' mean motion since the last keyframe [px], ``baseline`` the camera's by
    the median depth, ``survival`` the share of that keyframe's tracks which must be left.
    """

    flow: float
    baseline: float
    survival: float

    @staticmethod
    def unseen_in(layout: Layout) -> list[str]:
        """Return the names of what a teacher looks at and an observation does not hold."""
        return [name for name in (FLOW, BASELINE, SURVIVAL) if (name, 1) not in layout]

    def decide(self, observations: np.ndarray, layout: Layout) -> np.ndarray:
        """Return 1 where it keeps, else 0, (N,) for observations (N, D) in this layout."""
        seen = indices_of(((FLOW, 1), (BASELINE, 1), (SURVIVAL, 1)), layout)
        flow, baseline, survival = observations[:, seen].T
        return ((flow > np.log1p(self.flow)) | (baseline > self.baseline)
                | (survival < self.survival)).astype(np.int64)
