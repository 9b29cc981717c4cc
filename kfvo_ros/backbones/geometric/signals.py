# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a solved window tells a keyframe policy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric.observations import View
from kfvo_ros.backbones.geometric.window import Solution

SIGNAL_NAMES = ('track_survival', 'flow', 'parallax', 'gap', 'baseline_to_depth', 'rotation',
                'inlier_share', 'depth_information')


@dataclass(frozen=True)
class Motion:
    """How the newest frame moved against the last keyframe, and against the whole window.

    Parallax is what the best rotation leaves of the flow: a wrong translation cannot feign it.

    ``survival`` share of the keyframe's tracks still seen; ``flow`` and ``parallax`` (flow
    after the rotation is taken out), medians [px]; ``window_parallax`` the largest such median
    against any frame of the window [px]; ``gap`` [input frames].
    """

    survival: float
    flow: float
    parallax: float
    window_parallax: float
    gap: int


def measure_motion(solution: Solution, keyframe: View, newest: View, focal: float) -> Motion:
    """Compare the newest frame with the last keyframe and with the whole window."""
    shared = np.isin(keyframe.tracks.ids, newest.tracks.ids, assume_unique=True).sum()
    last = solution.observations.mask.shape[1] - 1
    parallaxes = [_median_shift(solution, frame, last, focal, True)
                  for frame in range(solution.anchor, last)]
    return Motion(float(shared) / max(len(keyframe.tracks), 1),
                  _median_shift(solution, last - 1, last, focal, False), parallaxes[-1],
                  max(parallaxes), newest.index - keyframe.index)


def signals(solution: Solution, motion: Motion) -> np.ndarray:
    """Return (len(SIGNAL_NAMES),) float32; pixels and information as log(1 + x), angles [rad]."""
    poses = solution.T_anchor_frame
    T_keyframe_newest = geometry.relative(poses[-2], poses[-1])
    points = solution.points()
    depth = float(np.median(points.depths)) if len(points.ids) else 1.0
    newest = solution.observations.mask[:, -1]
    return np.array([
        motion.survival, np.log1p(motion.flow), np.log1p(motion.parallax), motion.gap,
        np.linalg.norm(T_keyframe_newest[:3, 3]) / max(depth, 1e-9),
        geometry.rotation_angle(T_keyframe_newest[:3, :3]),
        solution.inliers[newest, -1].mean() if newest.any() else 0.0,
        np.log1p(np.median(points.information)) if len(points.ids) else 0.0], dtype=np.float32)


def _median_shift(solution: Solution, a: int, b: int, focal: float, derotated: bool) -> float:
    """Return the median motion of rays from frame a to b [px], zero without common tracks."""
    observations = solution.observations
    both = observations.mask[:, a] & observations.mask[:, b]
    if not both.any():
        return 0.0
    before, after = (geometry.unit_rays(observations.seen[both, frame]) for frame in (a, b))
    if derotated:
        before = before @ geometry.best_rotation(before, after).T
    return focal * float(np.median(np.linalg.norm(after - before, axis=1)))
