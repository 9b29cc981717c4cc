# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a solved window tells a keyframe policy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros import geometry, track_ids
from kfvo_ros.backbones.geometric import kernels
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
    shared, _ = track_ids.shared(keyframe.tracks.ids, newest.tracks.ids)
    seen, mask = solution.observations.seen, solution.observations.mask
    rotations = geometry.nearest_rotation(kernels.correlate(seen, mask, solution.anchor))
    parallaxes = focal * kernels.median_shifts(seen, mask, solution.anchor, rotations)
    flow = focal * kernels.median_shifts(seen, mask, mask.shape[1] - 2, np.eye(3)[None])
    return Motion(len(shared) / max(len(keyframe.tracks), 1), float(flow[-1]),
                  float(parallaxes[-1]), float(parallaxes.max()), newest.index - keyframe.index)


def signals(solution: Solution, motion: Motion) -> np.ndarray:
    """Return (len(SIGNAL_NAMES),) float32; pixels and information as log(1 + x), angles [rad]."""
    poses = solution.T_anchor_frame
    T_keyframe_newest = geometry.relative(poses[-2], poses[-1])
    points = solution.points
    depth = kernels.median(points.depths) if len(points.ids) else 1.0
    newest = solution.observations.mask[:, -1]
    return np.array([
        motion.survival, np.log1p(motion.flow), np.log1p(motion.parallax), motion.gap,
        np.linalg.norm(T_keyframe_newest[:3, 3]) / max(depth, 1e-9),
        geometry.rotation_angle(T_keyframe_newest[:3, :3]),
        solution.problem.mask[-1, newest].mean() if newest.any() else 0.0,
        np.log1p(solution.median_information)], dtype=np.float32)
