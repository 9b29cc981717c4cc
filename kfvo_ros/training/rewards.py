# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rewards of keyframe decisions, from estimated and true poses (paper, section IV-D)."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.geometry import Similarity

ERROR_WEIGHT, KEYFRAME_WEIGHT = 0.01, 0.005
ACCEPTED_ERROR_M = 0.2
"""Error of the newest frame with a reward of zero [m]."""
MIN_ERROR_TERM = -1.0
ALPHA = 2.5e-5
"""The paper's term for a keyframe, as printed; a penalty has the opposite sign."""
ALIGNED_FRAMES = 5
"""The first poses of the window, which are aligned to the truth."""
COLLINEAR_RATIO = 0.05
"""Positions with a smaller ratio of second to first singular value are collinear: the rotation
about their line is not observable."""
STANDSTILL_M = 0.01
"""Below this true motion [m] the scale is not observable."""
MIN_SPAN, MIN_SPAN_SHARE = 100, 2 / 3
"""Frames before the local reward begins, and their share of a shorter span: over fewer frames
the noise of a pose outweighs the effect of keyframes on the trajectory."""
ACCEPTED_SHARE, ACCEPTED_M = 3e-3, 2e-3
"""The error with a quality of zero: a share of the path, plus metres."""
MAX_QUALITY = 3.0
"""Quality is clipped at errors of exp(-MAX_QUALITY) and exp(MAX_QUALITY) times the accepted."""


class Reward(ABC):
    """Reward of the decisions of one episode; one object serves one episode.

    It takes the poses of the window's frames or, where ``span`` is set, of the latest ``span``
    input frames. ``quality`` is that of the trajectory so far, for rewards which are its change.
    """

    span: int | None = None
    quality = 0.0

    @abstractmethod
    def __call__(self, T_world_frame: np.ndarray, T_truth_frame: np.ndarray,
                 keep: bool) -> float:
        """Return the reward of a decision from estimated and true poses (S, 4, 4)."""


class PaperReward(Reward):
    """The error of the newest frame after alignment of the window's first poses to the truth.

    The last scale is kept for windows at rest. `alpha` is added, weighted, for a keyframe.
    """

    def __init__(self, alpha: float = ALPHA) -> None:
        self._alpha = alpha
        self._scale = 1.0

    def __call__(self, T_world_frame: np.ndarray, T_truth_frame: np.ndarray,
                 keep: bool) -> float:
        """Return the reward of a decision on a window."""
        error = self.error(T_world_frame, T_truth_frame)
        return (ERROR_WEIGHT * max(MIN_ERROR_TERM, ACCEPTED_ERROR_M - error)
                + KEYFRAME_WEIGHT * self._alpha * keep)

    def error(self, T_world_frame: np.ndarray, T_truth_frame: np.ndarray) -> float:
        """Return the position error of the window's newest frame [m]."""
        alignment = align(T_world_frame[:ALIGNED_FRAMES], T_truth_frame[:ALIGNED_FRAMES],
                          self._scale)
        self._scale = alignment.scale
        newest = alignment.transform_points(T_world_frame[-1:, :3, 3])[0]
        return float(np.linalg.norm(newest - T_truth_frame[-1, :3, 3]))


def align(T_world_frame: np.ndarray, T_truth_frame: np.ndarray, last_scale: float) -> Similarity:
    """Return the similarity that aligns estimated poses (N, 4, 4) to true ones.

    The positions of most windows are nearly collinear: then the rotation comes from the
    orientations, and only scale and translation from the positions. At rest, and for a scale
    that would not be positive, `last_scale` is kept.
    """
    source, target = T_world_frame[:, :3, 3], T_truth_frame[:, :3, 3]
    centred_source, centred_target = (each - each.mean(axis=0) for each in (source, target))
    at_rest = np.linalg.norm(np.ptp(target, axis=0)) < STANDSTILL_M
    if not at_rest and np.ptp(source, axis=0).any():
        first, second, *_ = np.linalg.svd(centred_target, compute_uv=False)
        if second >= COLLINEAR_RATIO * first:
            return geometry.umeyama(source, target)
    # R_truth_frame = R R_world_frame for every frame: the nearest rotation to all of them.
    rotation = geometry.best_rotation(
        np.swapaxes(T_world_frame[:, :3, :3], 1, 2).reshape(-1, 3),
        np.swapaxes(T_truth_frame[:, :3, :3], 1, 2).reshape(-1, 3))
    scale, power = last_scale, float(np.sum(centred_source ** 2))
    if not at_rest and power > 0.0:
        fitted = float(np.sum(centred_target * (centred_source @ rotation.T))) / power
        scale = fitted if fitted > 0.0 else last_scale
    return Similarity(scale, rotation,
                      target.mean(axis=0) - scale * rotation @ source.mean(axis=0))


class LocalReward(Reward):
    """The change in quality of the positions of the last `span` frames.

    A window does not see the drift of scale between windows, which makes nearly all of a
    trajectory's error; stretches of some hundred frames do. The change is rewarded, because the
    error itself would be in all later rewards and hide the effect of one decision. `alpha` is
    added for a keyframe.
    """

    def __init__(self, span: int, alpha: float = 0.0) -> None:
        self.span = span
        self._min_frames = min(MIN_SPAN, round(MIN_SPAN_SHARE * span))
        self._alpha = alpha

    def __call__(self, T_world_frame: np.ndarray, T_truth_frame: np.ndarray,
                 keep: bool) -> float:
        """Return the reward of a decision; with too few frames quality does not change."""
        before = self.quality
        if len(T_world_frame) >= self._min_frames:
            self.quality = trajectory_quality(T_world_frame[:, :3, 3], T_truth_frame[:, :3, 3])
        return self.quality - before + self._alpha * keep


def trajectory_quality(estimated: np.ndarray, true: np.ndarray) -> float:
    """Return the quality of positions (N, 3) after Sim(3) alignment.

    That is the logarithm of the accepted error over the RMSE, within +-MAX_QUALITY.
    """
    differences = geometry.umeyama(estimated, true).transform_points(estimated) - true
    path = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    error = np.sqrt(np.mean(np.sum(differences ** 2, axis=1)))
    ratio = error / (ACCEPTED_SHARE * path + ACCEPTED_M)
    return -float(np.clip(np.log(max(ratio, 1e-9)), -MAX_QUALITY, MAX_QUALITY))
