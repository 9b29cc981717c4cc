# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of the window's bundle adjustment.

A point is an inverse depth r along the ray b = (x, y, 1) through its pixel in its *host*, the
first frame of the window that sees it. With poses T_anchor_frame = (R, t), hosted in h and seen
in j, the point lies in j along

    p = R_j^T (R_h b + r (t_h - t_j)),

its residual is focal (p_xy / p_z - seen_xy) [px], and derivatives are taken for R <- R exp(w),
t <- t + d. Rays and `seen` are normalised, undistorted coordinates. Arrays: rotations (F, 3, 3),
translations (F, 3), inverse_depths (P,), hosts (P,), rays (P, 3), seen (P, F, 2), mask (P, F).
"""

from __future__ import annotations

import math

import numba
import numpy as np

MIN_DEPTH = 1e-3
"""A point nearer than this share of its host depth, or behind, has no residual ..."""
BEHIND_ERROR = 100.0
"""... and counts as this many pixels off."""

_compiled = numba.njit(cache=True, nogil=True, error_model='numpy')


@_compiled
def _rotate(R, v0, v1, v2):
    return (R[0, 0] * v0 + R[0, 1] * v1 + R[0, 2] * v2,
            R[1, 0] * v0 + R[1, 1] * v1 + R[1, 2] * v2,
            R[2, 0] * v0 + R[2, 1] * v1 + R[2, 2] * v2)


@_compiled
def _rotate_back(R, v0, v1, v2):
    return (R[0, 0] * v0 + R[1, 0] * v1 + R[2, 0] * v2,
            R[0, 1] * v0 + R[1, 1] * v1 + R[2, 1] * v2,
            R[0, 2] * v0 + R[1, 2] * v1 + R[2, 2] * v2)


@_compiled
def _into_frame(rotations, translations, h, j, ray, r):
    """Return p of the module's docstring for a ray already turned into the anchor."""
    return _rotate_back(rotations[j], ray[0] + r * (translations[h, 0] - translations[j, 0]),
                        ray[1] + r * (translations[h, 1] - translations[j, 1]),
                        ray[2] + r * (translations[h, 2] - translations[j, 2]))


@_compiled
def reprojection_errors(rotations, translations, inverse_depths, hosts, rays, seen, mask, focal):
    """Return errors (P, F) [px]: 0 where unseen or hosted, BEHIND_ERROR behind a camera."""
    points, frames = mask.shape
    errors = np.zeros((points, frames))
    for k in range(points):
        h = hosts[k]
        ray = _rotate(rotations[h], rays[k, 0], rays[k, 1], rays[k, 2])
        for j in range(frames):
            if not mask[k, j] or j == h:
                continue
            x, y, z = _into_frame(rotations, translations, h, j, ray, inverse_depths[k])
            if z < MIN_DEPTH:
                errors[k, j] = BEHIND_ERROR
            else:
                errors[k, j] = focal * math.hypot(x / z - seen[k, j, 0], y / z - seen[k, j, 1])
    return errors


@_compiled
def _differentiate(rotations, translations, h, j, ray, b, r, p, focal, J, J_depth):
    """Fill the derivatives of a residual.

    J (2, 12) is that by host rotation, host shift, seeing rotation and seeing shift; J_depth
    (2,) that by the inverse depth.
    """
    x, y, z = p
    for a in range(2):
        # d residual_a / d p, then the same turned into the anchor and into the host.
        across = focal / z
        along = -focal * (x if a == 0 else y) / (z * z)
        a0, a1, a2 = (across, 0.0, along) if a == 0 else (0.0, across, along)
        m0, m1, m2 = _rotate(rotations[j], a0, a1, a2)
        v0, v1, v2 = _rotate_back(rotations[h], m0, m1, m2)
        J[a, 0] = v2 * b[1] - v1 * b[2]
        J[a, 1] = v0 * b[2] - v2 * b[0]
        J[a, 2] = v1 * b[0] - v0 * b[1]
        J[a, 3], J[a, 4], J[a, 5] = r * m0, r * m1, r * m2
        J[a, 6] = a1 * z - a2 * y
        J[a, 7] = a2 * x - a0 * z
        J[a, 8] = a0 * y - a1 * x
        J[a, 9], J[a, 10], J[a, 11] = -r * m0, -r * m1, -r * m2
        J_depth[a] = (m0 * (translations[h, 0] - translations[j, 0])
                      + m1 * (translations[h, 1] - translations[j, 1])
                      + m2 * (translations[h, 2] - translations[j, 2]))


@_compiled
def _accumulate(J, J_depth, e0, e1, weight, first_host, first_seen, k, H_cc, g_c, H_pc, H_pp,
                g_p):
    """Add one observation to the normal equations; rows of fixed frames are negative.

    A host comes before the frames that see it, so this fills H_cc below its diagonal.
    """
    H_pp[k] += weight * (J_depth[0] ** 2 + J_depth[1] ** 2)
    g_p[k] += weight * (J_depth[0] * e0 + J_depth[1] * e1)
    for m in range(12):
        row = first_host + m if m < 6 else first_seen + m - 6
        if (first_host if m < 6 else first_seen) < 0:
            continue
        w0, w1 = weight * J[0, m], weight * J[1, m]
        g_c[row] += w0 * e0 + w1 * e1
        H_pc[k, row] += w0 * J_depth[0] + w1 * J_depth[1]
        if first_host >= 0:
            for n in range(6):
                H_cc[row, first_host + n] += w0 * J[0, n] + w1 * J[1, n]
        if m >= 6:
            for n in range(6):
                H_cc[row, first_seen + n] += w0 * J[0, n + 6] + w1 * J[1, n + 6]


@_compiled
def linearise(rotations, translations, inverse_depths, hosts, rays, seen, mask, focal, huber,
              fixed):
    """Return the normal equations (H_cc, g_c, H_pc, H_pp, g_p) at the present estimate.

    The first `fixed` frames do not move. With C = 6 (F - fixed), H_cc (C, C) and g_c (C,)
    belong to the poses (rotation, then translation, of each free frame), H_pp (P,) and g_p (P,)
    to the inverse depths, H_pc (P, C) couples them. H is the Gauss-Newton Hessian and g the
    gradient of half the Huber cost.
    """
    points, frames = mask.shape
    size = 6 * (frames - fixed)
    H_cc, g_c, H_pc = np.zeros((size, size)), np.zeros(size), np.zeros((points, size))
    H_pp, g_p = np.zeros(points), np.zeros(points)
    J, J_depth = np.zeros((2, 12)), np.zeros(2)
    for k in range(points):
        h, r = hosts[k], inverse_depths[k]
        ray = _rotate(rotations[h], rays[k, 0], rays[k, 1], rays[k, 2])
        for j in range(frames):
            if not mask[k, j] or j == h:
                continue
            p = _into_frame(rotations, translations, h, j, ray, r)
            if p[2] < MIN_DEPTH:
                continue
            e0 = focal * (p[0] / p[2] - seen[k, j, 0])
            e1 = focal * (p[1] / p[2] - seen[k, j, 1])
            error = math.sqrt(e0 * e0 + e1 * e1)
            weight = 1.0 if error < huber else huber / error
            _differentiate(rotations, translations, h, j, ray, rays[k], r, p, focal, J, J_depth)
            _accumulate(J, J_depth, e0, e1, weight, 6 * (h - fixed), 6 * (j - fixed), k, H_cc,
                        g_c, H_pc, H_pp, g_p)
    for row in range(size):
        H_cc[row, row + 1:] = H_cc[row + 1:, row]
    return H_cc, g_c, H_pc, H_pp, g_p


@_compiled
def triangulate(rotations, translations, hosts, rays, seen, mask):
    """Return closed-form inverse depths (P,) and their parallax weights (P,).

    Minimises the algebraic error over all observations outside the host; the weight is the sum
    of squared shifts of the image point per unit of inverse depth, zero where nothing is learnt.
    """
    points, frames = mask.shape
    inverse_depths, weights = np.zeros(points), np.zeros(points)
    for k in range(points):
        h = hosts[k]
        ray = _rotate(rotations[h], rays[k, 0], rays[k, 1], rays[k, 2])
        numerator = 0.0
        for j in range(frames):
            if not mask[k, j] or j == h:
                continue
            a = _into_frame(rotations, translations, h, j, ray, 0.0)
            c = _rotate_back(rotations[j], translations[h, 0] - translations[j, 0],
                             translations[h, 1] - translations[j, 1],
                             translations[h, 2] - translations[j, 2])
            for axis in range(2):
                slope = c[axis] - seen[k, j, axis] * c[2]
                numerator += slope * (seen[k, j, axis] * a[2] - a[axis])
                weights[k] += slope * slope
        if weights[k] > 0.0:
            inverse_depths[k] = numerator / weights[k]
    return inverse_depths, weights


def load() -> None:
    """Compile every kernel, or load it from the cache, before a frame would wait for it."""
    rotations, translations = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    hosts, rays, seen = np.zeros(1, dtype=np.int64), np.ones((1, 3)), np.zeros((1, 2, 2))
    mask = np.ones((1, 2), dtype=bool)
    state = rotations, translations, np.ones(1)
    reprojection_errors(*state, hosts, rays, seen, mask, 1.0)
    linearise(*state, hosts, rays, seen, mask, 1.0, 1.0, 1)
    triangulate(rotations, translations, hosts, rays, seen, mask)
