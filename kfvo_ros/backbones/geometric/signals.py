# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a solved window tells a keyframe policy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric.numba_utils import compiled, median
from kfvo_ros.backbones.geometric.observations import FrameTracks, TrackTable
from kfvo_ros.backbones.geometric.triangulation import rotate
from kfvo_ros.backbones.geometric.window import Solution
from kfvo_ros.tracking.tracker import common, mean_flow

SIGNAL_NAMES = ('track_survival', 'flow', 'parallax', 'gap', 'baseline_to_depth', 'rotation',
                'inlier_share', 'depth_information')
HELD_PARALLAX = 1.0
"""With less parallax to every keyframe of the window a frame tells nothing of translation [px]."""


@compiled
def _unit_ray(seen):
    length = math.sqrt(seen[0] * seen[0] + seen[1] * seen[1] + 1.0)
    return seen[0] / length, seen[1] / length, 1.0 / length


@compiled
def correlate(seen, mask, first):
    """Return sums (F - 1 - first, 3, 3) of ray_newest ray_frame^T of common tracks, unit rays.

    One for each frame from `first` on but the newest.
    """
    points, frames = mask.shape
    sums = np.zeros((frames - 1 - first, 3, 3))
    for k in range(points):
        if mask[k, -1]:
            newest = _unit_ray(seen[k, -1])
            for frame in range(first, frames - 1):
                if mask[k, frame]:
                    ray = _unit_ray(seen[k, frame])
                    for a in range(3):
                        for b in range(3):
                            sums[frame - first, a, b] += newest[a] * ray[b]
    return sums


@compiled
def median_shifts(seen, mask, first, rotations):
    """Return medians (F - 1 - first,) of |ray_newest - rotation ray_frame| of common tracks.

    One for each frame from `first` on but the newest; 0 without common tracks.
    """
    points, frames = mask.shape
    medians, shifts = np.zeros(frames - 1 - first), np.zeros(points)
    for frame in range(first, frames - 1):
        count = 0
        for k in range(points):
            if mask[k, -1] and mask[k, frame]:
                newest, ray = _unit_ray(seen[k, -1]), _unit_ray(seen[k, frame])
                x, y, z = rotate(rotations[frame - first], ray[0], ray[1], ray[2])
                shifts[count] = math.sqrt((newest[0] - x) ** 2 + (newest[1] - y) ** 2
                                          + (newest[2] - z) ** 2)
                count += 1
        if count > 0:
            medians[frame - first] = median(shifts[:count])
    return medians


@dataclass(frozen=True)
class NewestMotion:
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


def measure_motion(solution: Solution, keyframe: FrameTracks, newest: FrameTracks, focal: float) -> NewestMotion:
    """Compare the newest frame with the last keyframe and with the whole window."""
    before, after = common(keyframe.tracks, newest.tracks)
    observations, last = solution.observations, solution.observations.mask.shape[1] - 2
    parallax = float(focal * _shifts(observations, last)[0])
    held = bool(parallax < HELD_PARALLAX  # Most frames need not be compared with all the others.
                and focal * _shifts(observations, solution.anchor).max() < HELD_PARALLAX)
    return NewestMotion(len(before) / max(len(keyframe.tracks), 1), mean_flow(before, after),
                        parallax, held, newest.index - keyframe.index)


def _shifts(observations: TrackTable, first: int) -> np.ndarray:
    """Return what rotation leaves of the newest frame's flow against each from `first` on."""
    seen, mask = observations.seen, observations.mask
    rotations = geometry.nearest_rotation(correlate(seen, mask, first))
    return np.asarray(median_shifts(seen, mask, first, rotations))


def signals(solution: Solution, motion: NewestMotion) -> np.ndarray:
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
