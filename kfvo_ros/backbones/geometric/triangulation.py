# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled loops around the bundle adjustment: what goes into a window, what comes out of it.

Arrays are those of `Observations`: hosts (P,), rays (P, 3), seen (P, F, 2), mask (P, F).
"""

from __future__ import annotations

import numpy as np

from kfvo_ros.backbones.geometric.numba_utils import compiled


@compiled
def rotate(R, v0, v1, v2):
    """Return R v, component by component."""
    return (R[0, 0] * v0 + R[0, 1] * v1 + R[0, 2] * v2,
            R[1, 0] * v0 + R[1, 1] * v1 + R[1, 2] * v2,
            R[2, 0] * v0 + R[2, 1] * v1 + R[2, 2] * v2)


@compiled
def rotate_back(R, v0, v1, v2):
    """Return R^T v, component by component."""
    return (R[0, 0] * v0 + R[1, 0] * v1 + R[2, 0] * v2,
            R[0, 1] * v0 + R[1, 1] * v1 + R[2, 1] * v2,
            R[0, 2] * v0 + R[1, 2] * v1 + R[2, 2] * v2)


@compiled
def triangulate(rotations, translations, hosts, rays, seen, mask):
    """Return closed-form inverse depths (P,) and their parallax weights (P,).

    Minimises the algebraic error over all observations outside the host; the weight is the sum
    of squared shifts of the image point per unit of inverse depth, zero where nothing is learnt.
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
            a = rotate_back(rotations[j], ray[0], ray[1], ray[2])
            c = rotate_back(rotations[j], translations[h, 0] - translations[j, 0],
                            translations[h, 1] - translations[j, 1],
                            translations[h, 2] - translations[j, 2])
            for axis in range(2):
                slope = c[axis] - seen[k, j, axis] * c[2]
                numerator += slope * (seen[k, j, axis] * a[2] - a[axis])
                weights[k] += slope * slope
        if weights[k] > 0.0:
            inverse_depths[k] = numerator / weights[k]
    return inverse_depths, weights


@compiled
def point_positions(rotations, translations, hosts, rays, inverse_depths):
    """Return positions (P, 3) of points in the frame that the hosts' poses are in."""
    positions = np.empty((len(hosts), 3))
    for k in range(len(hosts)):
        x, y, z = rotate(rotations[hosts[k]], rays[k, 0], rays[k, 1], rays[k, 2])
        positions[k, 0] = x / inverse_depths[k] + translations[hosts[k], 0]
        positions[k, 1] = y / inverse_depths[k] + translations[hosts[k], 1]
        positions[k, 2] = z / inverse_depths[k] + translations[hosts[k], 2]
    return positions
