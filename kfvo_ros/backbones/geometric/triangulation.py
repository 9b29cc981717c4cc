# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Linear triangulation of inverse depths, and positions of points; compiled.

Arrays are those of a `TrackTable`: hosts (P,), rays (P, 3), image_points (P, F, 2), mask (P, F).
Poses are rotations (F, 3, 3) and translations (F, 3) of frames in a common frame.
"""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64

from kfvo_ros.backbones.geometric.numba_utils import compiled, entry_point


@compiled
def rotate(R: np.ndarray, v0: float, v1: float, v2: float) -> tuple[float, float, float]:
    """Return the components of R v."""
    return (R[0, 0] * v0 + R[0, 1] * v1 + R[0, 2] * v2,
            R[1, 0] * v0 + R[1, 1] * v1 + R[1, 2] * v2,
            R[2, 0] * v0 + R[2, 1] * v1 + R[2, 2] * v2)


@compiled
def rotate_inverse(R: np.ndarray, v0: float, v1: float, v2: float) -> tuple[float, float, float]:
    """Return the components of R^T v."""
    return (R[0, 0] * v0 + R[1, 0] * v1 + R[2, 0] * v2,
            R[0, 1] * v0 + R[1, 1] * v1 + R[2, 1] * v2,
            R[0, 2] * v0 + R[1, 2] * v1 + R[2, 2] * v2)


@entry_point(float64[:, :, ::1], float64[:, ::1], int64[::1], float64[:, ::1],
             float64[:, :, ::1], boolean[:, ::1])
def triangulate(rotations: np.ndarray, translations: np.ndarray, hosts: np.ndarray,
                rays: np.ndarray, image_points: np.ndarray,
                mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inverse depths (P,) in the hosts and their parallax weights (P,).

    The inverse depth minimises the algebraic error of all observations outside the host. The
    weight is the sum of squared shifts of the image point per unit of inverse depth; it is zero
    without parallax.
    """
    points, frames = mask.shape
    inverse_depths, weights = np.zeros(points), np.zeros(points)
    for k in range(points):
        h = hosts[k]
        ray = rotate(rotations[h], rays[k, 0], rays[k, 1], rays[k, 2])
        numerator = 0.0
        for j in range(frames):
            if not mask[k, j] or j == h:
                continue
            a = rotate_inverse(rotations[j], ray[0], ray[1], ray[2])
            c = rotate_inverse(rotations[j], translations[h, 0] - translations[j, 0],
                               translations[h, 1] - translations[j, 1],
                               translations[h, 2] - translations[j, 2])
            for axis in range(2):
                slope = c[axis] - image_points[k, j, axis] * c[2]
                numerator += slope * (image_points[k, j, axis] * a[2] - a[axis])
                weights[k] += slope * slope
        if weights[k] > 0.0:
            inverse_depths[k] = numerator / weights[k]
    return inverse_depths, weights


@entry_point(float64[:, :, ::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[::1])
def point_positions(rotations: np.ndarray, translations: np.ndarray, hosts: np.ndarray,
                    rays: np.ndarray, inverse_depths: np.ndarray) -> np.ndarray:
    """Return positions (P, 3) of points in the common frame."""
    positions = np.empty((len(hosts), 3))
    for k in range(len(hosts)):
        x, y, z = rotate(rotations[hosts[k]], rays[k, 0], rays[k, 1], rays[k, 2])
        positions[k, 0] = x / inverse_depths[k] + translations[hosts[k], 0]
        positions[k, 1] = y / inverse_depths[k] + translations[hosts[k], 1]
        positions[k, 2] = z / inverse_depths[k] + translations[hosts[k], 2]
    return positions
