# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a solved window tells a keyframe policy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric import kernels
from kfvo_ros.backbones.geometric.observations import Observations, View
from kfvo_ros.backbones.geometric.window import Solution
from kfvo_ros.tracking import common, mean_flow

SIGNAL_NAMES = ('track_survival', 'flow', 'parallax', 'gap', 'baseline_to_depth', 'rotation',
                'inlier_share', 'depth_information')
HELD_PARALLAX = 1.0
"""With less parallax to every keyframe of the window a frame tells nothing of translation [px]."""


@dataclass(frozen=True)
class Motion:
    """How the newest frame moved against the last keyframe, and against the whole window.

    Parallax is what the best rotation leaves of the flow: a wrong translation cannot feign it.

    ``survival`` share of the keyframe's tracks still seen; ``flow`` their mean motion [px], for
    near things are few and count; ``parallax`` (what is left of it after the rotation is taken
    out) a median [px]; ``held`` whether there is next to none to any keyframe of the window;
    ``gap`` [input frames].
    """

    survival: float
    flow: float
    parallax: float
    held: bool
    gap: int


def measure_motion(solution: Solution, keyframe: View, newest: View, focal: float) -> Motion:
    """Compare the newest frame with the last keyframe and with the whole window."""
    before, after = common(keyframe.tracks, newest.tracks)
    observations, last = solution.observations, solution.observations.mask.shape[1] - 2
    parallax = float(focal * _shifts(observations, last)[0])
    held = bool(parallax < HELD_PARALLAX  # Most frames need not be compared with all the others.
                and focal * _shifts(observations, solution.anchor).max() < HELD_PARALLAX)
    return Motion(len(before) / max(len(keyframe.tracks), 1), mean_flow(before, after),
                  parallax, held, newest.index - keyframe.index)


def _shifts(observations: Observations, first: int) -> np.ndarray:
    """Return what rotation leaves of the newest frame's flow against each from `first` on."""
    seen, mask = observations.seen, observations.mask
    rotations = geometry.nearest_rotation(kernels.correlate(seen, mask, first))
    return np.asarray(kernels.median_shifts(seen, mask, first, rotations))


def signals(solution: Solution, motion: Motion) -> np.ndarray:
    """Return (len(SIGNAL_NAMES),) float32; pixels and information as log(1 + x), angles [rad]."""
    poses = solution.T_anchor_frame
    T_keyframe_newest = geometry.relative(poses[-2], poses[-1])
    newest = solution.observations.mask[:, -1]
    return np.array([
        motion.survival, np.log1p(motion.flow), np.log1p(motion.parallax), motion.gap,
        np.linalg.norm(T_keyframe_newest[:3, 3]) / max(solution.median_depth, 1e-9),
        geometry.rotation_angle(T_keyframe_newest[:3, :3]),
        solution.problem.mask[-1, newest].mean() if newest.any() else 0.0,
        np.log1p(solution.median_information)], dtype=np.float32)
