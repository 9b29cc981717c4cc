# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Normal equations of poses and points, solved for the poses first (Schur complement); compiled.

Each point has three unknowns that nothing but poses couple to others: with the Cholesky factors L
of their own 3x3 blocks, what couples them is made white, L^-1 H_pc, and its products are what the
poses' system loses. Those take most of the time, and less in numbers of 32 bits: exact enough for
a step, which is tried before it is believed, but not for what is told of a solved window.
"""

from __future__ import annotations

import math

import numpy as np

from kfvo_ros.backbones.geometric.numba_utils import compiled
from kfvo_ros.backbones.geometric.reprojection import NormalEquations

TINY = 1e-9


@compiled
def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Return the product of two vectors (N,): BLAS would take longer to be called."""
    total = a.dtype.type(0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled
def _add_nine(A: np.ndarray, B: np.ndarray, weight: float, total: np.ndarray) -> None:
    """Add weight A B^T of three rows each: a number read is used three times."""
    a0, a1, a2, b0, b1, b2 = A[0], A[1], A[2], B[0], B[1], B[2]
    s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = A.dtype.type(0)
    for k in range(len(a0)):
        s00 += a0[k] * b0[k]
        s01 += a0[k] * b1[k]
        s02 += a0[k] * b2[k]
        s10 += a1[k] * b0[k]
        s11 += a1[k] * b1[k]
        s12 += a1[k] * b2[k]
        s20 += a2[k] * b0[k]
        s21 += a2[k] * b1[k]
        s22 += a2[k] * b2[k]
    for m, (x, y, z) in enumerate(((s00, s01, s02), (s10, s11, s12), (s20, s21, s22))):
        total[m, 0] += weight * x
        total[m, 1] += weight * y
        total[m, 2] += weight * z


@compiled
def add_products(A: np.ndarray, weight: float, total: np.ndarray) -> None:
    """Add weight A A^T of A (M, N) to `total` (M, M), which is and stays symmetric."""
    size = len(A)
    threes = size - size % 3
    for row in range(0, threes, 3):
        for column in range(0, row + 1, 3):
            _add_nine(A[row:row + 3], A[column:column + 3], weight,
                      total[row:row + 3, column:column + 3])
    for row in range(threes, size):
        for column in range(row + 1):
            total[row, column] += weight * dot(A[row], A[column])
    for row in range(size):
        for column in range(row):
            total[column, row] = total[row, column]


@compiled
def _factor(H: np.ndarray, damping: float) -> np.ndarray:
    """Return lower triangles (6, P) of the points' Cholesky factors, diagonals inverted."""
    L, grown = np.empty(H.shape), 1.0 + damping
    for k in range(H.shape[1]):
        xx = 1.0 / math.sqrt(H[0, k] * grown + TINY)
        yx = H[1, k] * xx
        yy = 1.0 / math.sqrt(max(H[2, k] * grown - yx * yx, 0.0) + TINY)
        rx = H[3, k] * xx
        ry = (H[4, k] - rx * yx) * yy
        rr = 1.0 / math.sqrt(max(H[5, k] * grown - rx * rx - ry * ry, 0.0) + TINY)
        L[0, k], L[1, k], L[2, k], L[3, k], L[4, k], L[5, k] = xx, yx, yy, rx, ry, rr
    return L


@compiled
def _whiten(L: np.ndarray, v: np.ndarray) -> None:
    """Make L^-1 v of v (3, P) in place."""
    for k in range(v.shape[1]):
        x = v[0, k] * L[0, k]
        y = (v[1, k] - L[1, k] * x) * L[2, k]
        v[0, k], v[1, k] = x, y
        v[2, k] = (v[2, k] - L[3, k] * x - L[4, k] * y) * L[5, k]


@compiled
def _eliminate(normal: NormalEquations, damping: float,
               L: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return system and gradient of the poses, and the white gradient (3, P) of the points.

    What couples the two is whitened in place.
    """
    size, system, gradient = len(normal.g_c), normal.H_cc.copy(), normal.g_c.copy()
    pull = normal.g_p.astype(L.dtype)
    _whiten(L, pull)
    for row in range(size):
        _whiten(L, normal.H_cp[row])
    white, flat = normal.H_cp.reshape(size, pull.size), pull.reshape(pull.size)
    add_products(white, -1.0, system)
    for row in range(size):
        system[row, row] += damping * normal.H_cc[row, row] + TINY
        gradient[row] -= dot(white[row], flat)
    return system, gradient, pull


@compiled
def reduce(normal: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
    """Eliminate the points (Schur complement); return system and gradient of the poses.

    The equations are used up: a copy of them would not fit into the processor's cache.
    """
    system, gradient, _ = _eliminate(normal, 0.0, _factor(normal.H_pp, 0.0))
    return system, gradient


@compiled
def _solve(system: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric, positive definite system, both overwritten: no pivot is ever needed."""
    size = len(right)
    for pivot in range(size):
        for row in range(pivot + 1, size):
            share = system[pivot, row] / system[pivot, pivot]
            right[row] -= share * right[pivot]
            for column in range(row, size):
                system[row, column] -= share * system[pivot, column]
    for row in range(size - 1, -1, -1):
        for column in range(row + 1, size):
            right[row] -= system[row, column] * right[column]
        right[row] /= system[row, row]
    return right


@compiled
def step(normal: NormalEquations, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the damped Gauss-Newton step of free poses (C,) and points (3, P).

    The equations are used up.
    """
    L = _factor(normal.H_pp, damping).astype(normal.H_cp.dtype)
    system, gradient, pull = _eliminate(normal, damping, L)
    poses, points = -_solve(system, gradient), -pull
    for row in range(len(poses)):
        share = L.dtype.type(poses[row])
        for a in range(3):
            change, coupling = points[a], normal.H_cp[row, a]
            for k in range(len(change)):
                change[k] -= share * coupling[k]
    for k in range(points.shape[1]):
        r = points[2, k] * L[5, k]
        y = (points[1, k] - L[4, k] * r) * L[2, k]
        points[0, k] = (points[0, k] - L[1, k] * y - L[3, k] * r) * L[0, k]
        points[1, k], points[2, k] = y, r
    return poses, points


def depth_information(normal: NormalEquations) -> np.ndarray:
    """Return what is known of the points' inverse depths (P,), given the poses, rays unknown."""
    return 1.0 / _factor(normal.H_pp, 0.0)[5] ** 2
