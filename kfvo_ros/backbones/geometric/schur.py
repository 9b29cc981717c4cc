# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Schur complement of normal equations: points are eliminated, poses are solved for; compiled.

Only poses couple points to each other, so each point has its own 3x3 block. With the Cholesky
factors L of those blocks the coupling is whitened, L^-1 H_pc, and its products are subtracted from
the poses' system. These products take most of the time. In float32 they take less; that is exact
enough for a step, whose cost is checked, but not for covariances.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64

from kfvo_ros.backbones.geometric.numba_utils import compiled, entry_point
from kfvo_ros.backbones.geometric.reprojection import NORMAL_EQUATIONS, NormalEquations

REGULARISATION = 1e-9
"""Added to diagonals, which may be zero."""


@compiled
def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Return the dot product of vectors (N,); for few numbers a call of BLAS takes longer."""
    total = a.dtype.type(0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled
def _add_3x3_products(A: np.ndarray, B: np.ndarray, weight: float, total: np.ndarray) -> None:
    """Add weight A B^T of three rows each: every number that is loaded is used three times."""
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
    """Add weight A A^T of A (M, N) to the symmetric `total` (M, M)."""
    size = len(A)
    threes = size - size % 3
    for row in range(0, threes, 3):
        for column in range(0, row + 1, 3):
            _add_3x3_products(A[row:row + 3], A[column:column + 3], weight,
                              total[row:row + 3, column:column + 3])
    for row in range(threes, size):
        for column in range(row + 1):
            total[row, column] += weight * dot(A[row], A[column])
    for row in range(size):
        for column in range(row):
            total[column, row] = total[row, column]


@entry_point(float64[:, ::1], float64)
def _factorise_points(H: np.ndarray, damping: float) -> np.ndarray:
    """Return lower triangles (6, P) of the points' Cholesky factors, diagonals inverted."""
    L, grown = np.empty(H.shape), 1.0 + damping
    for k in range(H.shape[1]):
        xx = 1.0 / math.sqrt(H[0, k] * grown + REGULARISATION)
        yx = H[1, k] * xx
        yy = 1.0 / math.sqrt(max(H[2, k] * grown - yx * yx, 0.0) + REGULARISATION)
        rx = H[3, k] * xx
        ry = (H[4, k] - rx * yx) * yy
        rr = 1.0 / math.sqrt(max(H[5, k] * grown - rx * rx - ry * ry, 0.0) + REGULARISATION)
        L[0, k], L[1, k], L[2, k], L[3, k], L[4, k], L[5, k] = xx, yx, yy, rx, ry, rr
    return L


@compiled
def _whiten(L: np.ndarray, v: np.ndarray) -> None:
    """Replace v (3, P) by L^-1 v."""
    for k in range(v.shape[1]):
        x = v[0, k] * L[0, k]
        y = (v[1, k] - L[1, k] * x) * L[2, k]
        v[0, k], v[1, k] = x, y
        v[2, k] = (v[2, k] - L[3, k] * x - L[4, k] * y) * L[5, k]


@compiled
def _eliminate_points(normal: NormalEquations, damping: float,
                      L: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return system and gradient of the poses, and the whitened gradient (3, P) of the points.

    The coupling H_cp is whitened in place.
    """
    size, system, gradient = len(normal.g_c), normal.H_cc.copy(), normal.g_c.copy()
    point_gradient = normal.g_p.astype(L.dtype)
    _whiten(L, point_gradient)
    for row in range(size):
        _whiten(L, normal.H_cp[row])
    coupling = normal.H_cp.reshape(size, point_gradient.size)
    flat = point_gradient.reshape(point_gradient.size)
    add_products(coupling, -1.0, system)
    for row in range(size):
        system[row, row] += damping * normal.H_cc[row, row] + REGULARISATION
        gradient[row] -= dot(coupling[row], flat)
    return system, gradient, point_gradient


@entry_point(NORMAL_EQUATIONS)
def marginalise_points(normal: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
    """Return system (C, C) and gradient (C,) of the poses without the points.

    H_cp is overwritten: a copy would not fit into the processor's cache.
    """
    system, gradient, _ = _eliminate_points(normal, 0.0, _factorise_points(normal.H_pp, 0.0))
    return system, gradient


@compiled
def _solve_positive(system: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric positive definite system without pivoting; both are overwritten."""
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
def solve_step(normal: NormalEquations, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the damped Gauss-Newton step of free poses (C,) and points (3, P).

    H_cp is overwritten.
    """
    L = _factorise_points(normal.H_pp, damping).astype(normal.H_cp.dtype)
    system, gradient, point_gradient = _eliminate_points(normal, damping, L)
    poses, points = -_solve_positive(system, gradient), -point_gradient
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
    """Return the information (P,) on inverse depths, given the poses, rays marginalised."""
    return 1.0 / _factorise_points(normal.H_pp, 0.0)[5] ** 2
