# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signals of a solved window for the keyframe policy, and detection of missing parallax."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import boolean, float64, int64

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric.numba_utils import compiled, entry_point, median
from kfvo_ros.backbones.geometric.observations import FrameTracks, TrackTable
from kfvo_ros.backbones.geometric.triangulation import rotate
from kfvo_ros.backbones.geometric.window import Solution
from kfvo_ros.tracking.tracker import common_pixels, mean_flow

SIGNAL_NAMES = ('track_survival', 'flow', 'parallax', 'gap', 'baseline_to_depth', 'rotation',
                'inlier_share', 'depth_information')
HELD_PARALLAX = 1.0
"""Translation is unobserved with less parallax to each keyframe of the window [px]."""


@dataclass(frozen=True)
class NewestMotion:
    """Image motion of the newest frame since the last keyframe and within the window.

    Parallax is the flow left over by the best rotation, which does not depend on the estimate.

    ``survival`` share of the keyframe's tracks that are still observed; ``flow`` their mean motion
    [px], so that a few near points count; ``parallax`` a median [px]; ``held`` whether it is below
    HELD_PARALLAX to each keyframe of the window; ``gap`` [input frames].
    """

    survival: float
    flow: float
    parallax: float
    held: bool
    gap: int


def measure_motion(solution: Solution, keyframe: FrameTracks, newest: FrameTracks,
                   focal: float) -> NewestMotion:
    """Compare the newest frame with the last keyframe and with the whole window."""
    before, after = common_pixels(keyframe.tracks, newest.tracks)
    table, last = solution.table, solution.table.mask.shape[1] - 2
    parallax = float(focal * _ray_shifts(table, last)[0])
    held = bool(parallax < HELD_PARALLAX  # Few frames need the comparison with all others.
                and focal * _ray_shifts(table, solution.anchor).max() < HELD_PARALLAX)
    return NewestMotion(len(before) / max(len(keyframe.tracks), 1), mean_flow(before, after),
                        parallax, held, newest.index - keyframe.index)


def compute_signals(solution: Solution, motion: NewestMotion) -> np.ndarray:
    """Return (len(SIGNAL_NAMES),) float32; pixels and information as log(1 + x), angles [rad]."""
    poses = solution.T_anchor_frame
    T_keyframe_newest = geometry.relative(poses[-2], poses[-1])
    newest = solution.table.mask[:, -1]
    return np.array([
        motion.survival, np.log1p(motion.flow), np.log1p(motion.parallax), motion.gap,
        np.linalg.norm(T_keyframe_newest[:3, 3]) / max(solution.median_depth, 1e-9),
        geometry.rotation_angle(T_keyframe_newest[:3, :3]),
        solution.problem.mask[-1, newest].mean() if newest.any() else 0.0,
        np.log1p(solution.median_information)], dtype=np.float32)


def _ray_shifts(table: TrackTable, first: int) -> np.ndarray:
    """Return median shifts of unit rays to the newest frame from each frame from `first` on.

    The best rotation of each frame is removed.
    """
    image_points, mask = table.image_points, table.mask
    rotations = geometry.nearest_rotation(correlate_rays(image_points, mask, first))
    return median_shifts(image_points, mask, first, rotations)


@entry_point(float64[:, :, ::1], boolean[:, ::1], int64)
def correlate_rays(image_points: np.ndarray, mask: np.ndarray, first: int) -> np.ndarray:
    """Return sums (F - 1 - first, 3, 3) of ray_newest ray_frame^T over common tracks, unit rays.

    Frames are those from `first` on but the newest; `image_points` (P, F, 2), `mask` (P, F).
    """
    points, frames = mask.shape
    sums = np.zeros((frames - 1 - first, 3, 3))
    for k in range(points):
        if mask[k, -1]:
            newest = _unit_ray(image_points[k, -1])
            for frame in range(first, frames - 1):
                if mask[k, frame]:
                    ray = _unit_ray(image_points[k, frame])
                    for a in range(3):
                        for b in range(3):
                            sums[frame - first, a, b] += newest[a] * ray[b]
    return sums


@entry_point(float64[:, :, ::1], boolean[:, ::1], int64, float64[:, :, ::1])
def median_shifts(image_points: np.ndarray, mask: np.ndarray, first: int,
                  rotations: np.ndarray) -> np.ndarray:
    """Return medians (F - 1 - first,) of |ray_newest - rotation ray_frame| over common tracks.

    Frames are those of `correlate_rays`; 0 without common tracks.
    """
    points, frames = mask.shape
    medians, shifts = np.zeros(frames - 1 - first), np.zeros(points)
    for frame in range(first, frames - 1):
        count = 0
        for k in range(points):
            if mask[k, -1] and mask[k, frame]:
                newest, ray = _unit_ray(image_points[k, -1]), _unit_ray(image_points[k, frame])
                x, y, z = rotate(rotations[frame - first], ray[0], ray[1], ray[2])
                shifts[count] = math.sqrt((newest[0] - x) ** 2 + (newest[1] - y) ** 2
                                          + (newest[2] - z) ** 2)
                count += 1
        if count > 0:
            medians[frame - first] = median(shifts[:count])
    return medians


@compiled
def _unit_ray(point: np.ndarray) -> tuple[float, float, float]:
    """Return the unit ray of a normalised image point (2,)."""
    length = math.sqrt(point[0] * point[0] + point[1] * point[1] + 1.0)
    return point[0] / length, point[1] / length, 1.0 / length
