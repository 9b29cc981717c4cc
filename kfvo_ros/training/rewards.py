# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a decision was worth, from the window's poses against the truth (paper, section IV-D)."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.geometry import Similarity

ERROR_WEIGHT, KEYFRAME_WEIGHT = 0.01, 0.005
ACCEPTED_ERROR = 0.2
"""An error of so many metres is worth nothing, neither good nor bad."""
WORST = -1.0
ALPHA = 2.5e-5
"""What a keyframe is worth as the paper prints it; as a penalty the sign turns."""
ALIGNED = 5
"""The first poses of the window are brought onto the truth."""
THIN = 0.05
"""Positions whose second singular value is below this share of the first lie on a line: they
tell no rotation about it."""
STANDSTILL_M = 0.01
"""Where the truth moved less, no scale can be told."""
LEAST_SPAN, LEAST_SHARE = 100, 2 / 3
"""Fewer frames say more of the noise in a pose than of what keyframes do to a trajectory; where
there are no more, this share of them has to tell."""
ACCEPTED_SHARE, ACCEPTED_M = 3e-3, 2e-3
"""An error of this share of the path and so many metres is worth nothing, good or bad ..."""
MOST = 3.0
"""... and one of exp(-MOST) of it, or exp(MOST) times it, is as good or bad as can be."""


class Reward(ABC):
    """What one decision of an episode is worth; one object serves one episode.

    It is told poses of the window's frames, or, where ``span`` is set, of that many input frames
    up to the newest. ``standing`` is how good the trajectory is so far, where the reward is by
    how much that changes.
    """

    span: int | None = None
    standing = 0.0

    @abstractmethod
    def __call__(self, T_world_frame: np.ndarray, T_truth_frame: np.ndarray,
                 keep: bool) -> float:
        """Return the worth of a decision from estimated and true poses (S, 4, 4)."""


class PaperReward(Reward):
    """The error of the newest frame once the window's first poses are aligned to the truth.

    Remembers the last scale, for windows at rest. `alpha` is added, weighted, for a keyframe.
    """

    def __init__(self, alpha: float = ALPHA) -> None:
        self._alpha = alpha
        self._scale = 1.0

    def __call__(self, T_world_frame: np.ndarray, T_truth_frame: np.ndarray,
                 keep: bool) -> float:
        """Return the reward of a decision on a window."""
        error = self.error(T_world_frame, T_truth_frame)
        return (ERROR_WEIGHT * max(WORST, ACCEPTED_ERROR - error)
                + KEYFRAME_WEIGHT * self._alpha * keep)

    def error(self, T_world_frame: np.ndarray, T_truth_frame: np.ndarray) -> float:
        """Return the position error of the window's newest frame [m]."""
        alignment = align(T_world_frame[:ALIGNED], T_truth_frame[:ALIGNED], self._scale)
        self._scale = alignment.scale
        newest = alignment.transform_points(T_world_frame[-1:, :3, 3])[0]
        return float(np.linalg.norm(newest - T_truth_frame[-1, :3, 3]))


def align(T_world_frame: np.ndarray, T_truth_frame: np.ndarray, last_scale: float) -> Similarity:
    """Return the similarity from the world to the truth that a few poses (N, 4, 4) tell.

    Positions of a window are nearly on a line in most: then the orientations tell the rotation,
    and the positions scale and translation only. Of poses at rest `last_scale` is kept.
    """
    source, target = T_world_frame[:, :3, 3], T_truth_frame[:, :3, 3]
    spread_source, spread_target = (each - each.mean(axis=0) for each in (source, target))
    at_rest = np.linalg.norm(np.ptp(target, axis=0)) < STANDSTILL_M
    if not at_rest and np.ptp(source, axis=0).any():
        first, second, *_ = np.linalg.svd(spread_target, compute_uv=False)
        if second >= THIN * first:
            return geometry.umeyama(source, target)
    # R_truth_frame = R R_world_frame for every frame: the nearest rotation to all of them.
    rotation = geometry.best_rotation(
        np.swapaxes(T_world_frame[:, :3, :3], 1, 2).reshape(-1, 3),
        np.swapaxes(T_truth_frame[:, :3, :3], 1, 2).reshape(-1, 3))
    scale, power = last_scale, float(np.sum(spread_source ** 2))
    if not at_rest and power > 0.0:
        told = float(np.sum(spread_target * (spread_source @ rotation.T))) / power
        scale = told if told > 0.0 else last_scale
    return Similarity(scale, rotation,
                      target.mean(axis=0) - scale * rotation @ source.mean(axis=0))


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
