# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a decision was worth to the trajectory, beyond the window it was made in."""

from __future__ import annotations

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.learning.reward import Reward

LEAST_SPAN, LEAST_SHARE = 100, 2 / 3
"""Fewer frames say more of the noise in a pose than of what keyframes do to a trajectory; where
there are no more, this share of them has to tell."""
ACCEPTED_SHARE, ACCEPTED_M = 3e-3, 2e-3
"""An error of this share of the path and so many metres is worth nothing, good or bad ..."""
MOST = 3.0
"""... and one of exp(-MOST) of it, or exp(MOST) times it, is as good or bad as can be."""


class LocalReward(Reward):
    """By how much the error of the last `span` frames' positions falls, on a log scale.

    A window is blind to the drift of scale between windows, which is nearly all of the error of
    a trajectory; stretches of some hundred frames see it. What is rewarded is the change: the
    error that is there already would be in all rewards to come, and drown what a decision adds.
    `alpha` is added for a keyframe.
    """

    def __init__(self, span: int, alpha: float = 0.0) -> None:
        self.span = span
        self._least = min(LEAST_SPAN, round(LEAST_SHARE * span))
        self._alpha = alpha

    def __call__(self, T_world_frame: np.ndarray, T_truth_frame: np.ndarray,
                 keep: bool) -> float:
        """Return the reward of a decision; without enough frames nothing is lost or won."""
        before = self.standing
        if len(T_world_frame) >= self._least:
            self.standing = standing_of(T_world_frame[:, :3, 3], T_truth_frame[:, :3, 3])
        return self.standing - before + self._alpha * keep


def standing_of(estimated: np.ndarray, true: np.ndarray) -> float:
    """Return how good positions (N, 3) are after Sim(3) alignment, from -MOST to MOST."""
    off = geometry.umeyama(estimated, true).transform_points(estimated) - true
    path = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    error = np.sqrt(np.mean(np.sum(off ** 2, axis=1)))
    ratio = error / (ACCEPTED_SHARE * path + ACCEPTED_M)
    return -float(np.clip(np.log(max(ratio, 1e-9)), -MOST, MOST))
