# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt over the poses and points of one window; compiled.

Poses are updated by R <- R exp(w), t <- t + R d; points by adding to x, y and inverse depth. The
first frames of a window may be fixed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import boolean, float64, int64, types

from kfvo_ros.backbones.geometric.numba_utils import compiled, entry_point
from kfvo_ros.backbones.geometric.reprojection import (
    MIN_DEPTH,
    PROBLEM,
    STATE,
    NormalEquations,
    Problem,
    State,
    cost,
    homogeneous_positions,
    observed_end,
    project,
)
from kfvo_ros.backbones.geometric.schur import add_products, dot, solve_step

INITIAL_DAMPING, MIN_DAMPING = 1e-4, 1e-7
DAMPING_DOWN, DAMPING_UP = 0.2, 8.0
MAX_REJECTIONS = 5
"""Rejected steps in a row that end the adjustment."""
MIN_IMPROVEMENT = 1e-3
"""A step that lowers the cost by a smaller share is the last one."""
MIN_INVERSE_DEPTH = 1e-4
"""Points are at most ten thousand times as far as the first scene."""
POSE, INTRINSICS, POINT = 6, 5, 3
"""Numbers of parameters of a residual, in the order of its derivatives."""
MAX_SQUARED_RADIUS = 2.0
"""|x|^2 is clipped 55 degrees off the axis: extrapolated to the rim of a fisheye, small errors of
the intrinsics would be huge."""


@entry_point(PROBLEM, STATE, int64)
def adjust(problem: Problem, state: State, iterations: int) -> State:
    """Return the state of least cost near `state`, after at most `iterations` accepted steps."""
    damping, current = INITIAL_DAMPING, cost(problem, state)
    for _ in range(iterations):
        for _ in range(MAX_REJECTIONS):
            normal = linearise(problem, state, False, np.float32)
            candidate = retract(state, *solve_step(normal, damping))
            candidate_cost = cost(problem, candidate)
            if candidate_cost < current:
                break
            damping *= DAMPING_UP
        else:
            return state
        improvement = 1.0 - candidate_cost / current
        state, current = candidate, candidate_cost
        damping = max(damping * DAMPING_DOWN, MIN_DAMPING)
        if improvement < MIN_IMPROVEMENT:
            break
    return state


@entry_point(PROBLEM, STATE, boolean, types.NumberClass(float64))
def linearise(problem: Problem, state: State, with_intrinsics: bool,
              precision: type[np.floating[Any]]) -> NormalEquations:
    """Return the normal equations at `state`, priors included; H_cp has this `precision`.

    `with_intrinsics` adds rows for INTRINSICS errors that are zero at present: e0, e1, e2 scale
    normalised points by 1 + e0 + e1 r^2 + e2 r^4 with r off the axis, then the principal point.
    """
    (frames, points), fixed = problem.mask.shape, problem.fixed
    normal = _prior_equations(problem, state, with_intrinsics, precision)
    parameters = POSE + INTRINSICS + POINT
    workspace = np.empty((6 + 2 * parameters) * points)
    positions, slopes = homogeneous_positions(problem, state.points)
    for j in range(frames):
        count = observed_end(problem, j)
        projection = workspace[:6 * count].reshape(6, count)
        J = workspace[6 * points:][:2 * parameters * count].reshape(parameters, 2, count)
        project(problem, state, positions, j, projection)
        _apply_loss(problem, j, projection)
        _differentiate_by_point(state.rotations[j], state.translations[j], slopes, projection,
                                J[POSE + INTRINSICS:])
        _add_point_blocks(J, projection, normal)
        if j >= fixed:
            _differentiate_by_pose(state.points, projection, J[:POSE])
            _add_pose_blocks(J, projection, POSE * (j - fixed), normal)
        if with_intrinsics:
            _differentiate_by_intrinsics(projection, J[POSE:POSE + INTRINSICS])
            _add_intrinsics_blocks(J, projection, POSE * (j - fixed), normal)
    return normal


@compiled
def _prior_equations(problem: Problem, state: State, with_intrinsics: bool,
                     precision: type[np.floating[Any]]) -> NormalEquations:
    """Return the normal equations of the depth priors alone."""
    frames, points = problem.mask.shape
    poses = POSE * (frames - problem.fixed)
    size = poses + INTRINSICS if with_intrinsics else poses
    H_cc, g_c = np.zeros((size, size)), np.zeros(size)
    H_cp = np.zeros((size, POINT, points), precision)
    H_pp, g_p = np.zeros((6, points)), np.zeros((POINT, points))
    for k in range(points):
        H_pp[5, k] = problem.prior_weights[k]
        g_p[2, k] = problem.prior_weights[k] * (state.points[2, k] - problem.prior_values[k])
    return NormalEquations(H_cc, g_c, H_cp, H_pp, g_p)


@compiled
def _apply_loss(problem: Problem, j: int, projection: np.ndarray) -> None:
    """Multiply residuals, projection[3:5], by the root of their weight in Cauchy's loss.

    projection[5] becomes focal length times certainty times that root. The root is 0 for points
    that frame j does not observe, and behind it.
    """
    squared_width, mask = problem.width ** 2, problem.mask[j]
    for k in range(projection.shape[1]):
        e0, e1 = projection[3, k], projection[4, k]
        root = math.sqrt(squared_width / (squared_width + e0 * e0 + e1 * e1))
        root = root if mask[k] and projection[2, k] < 1.0 / MIN_DEPTH else 0.0
        projection[3, k], projection[4, k] = root * e0, root * e1
        projection[5, k] = root * problem.certainty[k] * problem.focal


@compiled
def _differentiate_by_pose(points: np.ndarray, projection: np.ndarray, J: np.ndarray) -> None:
    """Fill J (POSE, 2, P), the derivatives of weighted residuals by the pose of their frame."""
    for k in range(projection.shape[1]):
        u, v, focal = projection[0, k], projection[1, k], projection[5, k]
        J[0, 0, k], J[0, 1, k] = focal * u * v, focal * (1.0 + v * v)
        J[1, 0, k], J[1, 1, k] = -focal * (1.0 + u * u), -focal * u * v
        J[2, 0, k], J[2, 1, k] = focal * v, -focal * u
    for k in range(projection.shape[1]):
        moved = projection[5, k] * projection[2, k] * points[2, k]
        J[3, 0, k], J[3, 1, k] = -moved, 0.0
        J[4, 0, k], J[4, 1, k] = 0.0, -moved
        J[5, 0, k], J[5, 1, k] = moved * projection[0, k], moved * projection[1, k]


@compiled
def _differentiate_by_intrinsics(projection: np.ndarray, J: np.ndarray) -> None:
    """Fill J (INTRINSICS, 2, P)."""
    for k in range(projection.shape[1]):
        u, v, focal = projection[0, k], projection[1, k], projection[5, k]
        off_axis = min(u * u + v * v, MAX_SQUARED_RADIUS)
        J[0, 0, k], J[0, 1, k] = focal * u, focal * v
        J[1, 0, k], J[1, 1, k] = off_axis * focal * u, off_axis * focal * v
        J[2, 0, k] = off_axis * off_axis * focal * u
        J[2, 1, k] = off_axis * off_axis * focal * v
        J[3, 0, k], J[3, 1, k] = focal, 0.0
        J[4, 0, k], J[4, 1, k] = 0.0, focal


@compiled
def _differentiate_by_point(R: np.ndarray, t: np.ndarray, slopes: np.ndarray,
                            projection: np.ndarray, J: np.ndarray) -> None:
    """Fill J (POINT, 2, P) in a frame at (R, t)."""
    for m in range(POINT):
        t0, t1, t2 = (t[0], t[1], t[2]) if m == 2 else (0.0, 0.0, 0.0)
        for k in range(projection.shape[1]):
            a, b, c = slopes[m, 0, k] - t0, slopes[m, 1, k] - t1, slopes[m, 2, k] - t2
            along = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c
            across = R[0, 0] * a + R[1, 0] * b + R[2, 0] * c
            down = R[0, 1] * a + R[1, 1] * b + R[2, 1] * c
            focal = projection[5, k] * projection[2, k]
            J[m, 0, k] = focal * (across - projection[0, k] * along)
            J[m, 1, k] = focal * (down - projection[1, k] * along)


@compiled
def _add_point_blocks(J: np.ndarray, projection: np.ndarray, normal: NormalEquations) -> None:
    """Add a frame's terms to H_pp and g_p; J is by all parameters of the residuals."""
    by_point, H_pp, g_p = J[POSE + INTRINSICS:], normal.H_pp, normal.g_p
    for k in range(projection.shape[1]):
        x0, x1, y0, y1 = by_point[0, 0, k], by_point[0, 1, k], by_point[1, 0, k], by_point[1, 1, k]
        r0, r1, e0, e1 = by_point[2, 0, k], by_point[2, 1, k], projection[3, k], projection[4, k]
        H_pp[0, k] += x0 * x0 + x1 * x1
        H_pp[1, k] += y0 * x0 + y1 * x1
        H_pp[2, k] += y0 * y0 + y1 * y1
        H_pp[3, k] += r0 * x0 + r1 * x1
        H_pp[4, k] += r0 * y0 + r1 * y1
        H_pp[5, k] += r0 * r0 + r1 * r1
        g_p[0, k] += x0 * e0 + x1 * e1
        g_p[1, k] += y0 * e0 + y1 * e1
        g_p[2, k] += r0 * e0 + r1 * e1


@compiled
def _add_pose_blocks(J: np.ndarray, projection: np.ndarray, pose: int,
                     normal: NormalEquations) -> None:
    """Add the terms of a free frame whose first row is `pose`."""
    by_point = J[POSE + INTRINSICS:]
    rows, residuals = J.reshape(len(J), 2 * J.shape[2]), projection[3:5].reshape(2 * J.shape[2])
    add_products(rows[:POSE], 1.0, normal.H_cc[pose:pose + POSE, pose:pose + POSE])
    for m in range(POSE):
        normal.g_c[pose + m] = dot(rows[m], residuals)
        _add_coupling(J[m], by_point, normal.H_cp[pose + m])


@compiled
def _add_intrinsics_blocks(J: np.ndarray, projection: np.ndarray, pose: int,
                           normal: NormalEquations) -> None:
    """Add a frame's terms in the errors of the intrinsics; `pose` < 0 for fixed frames."""
    by_point, first = J[POSE + INTRINSICS:], len(normal.g_c) - INTRINSICS
    rows, residuals = J.reshape(len(J), 2 * J.shape[2]), projection[3:5].reshape(2 * J.shape[2])
    for m in range(POSE, POSE + INTRINSICS):
        row = first + m - POSE
        normal.g_c[row] += dot(rows[m], residuals)
        _add_coupling(J[m], by_point, normal.H_cp[row])
        for n in range(0 if pose >= 0 else POSE, m + 1):
            column = pose + n if n < POSE else first + n - POSE
            normal.H_cc[row, column] += dot(rows[m], rows[n])
            normal.H_cc[column, row] = normal.H_cc[row, column]


@compiled
def _add_coupling(J_m: np.ndarray, J: np.ndarray, H_mp: np.ndarray) -> None:
    """Add the products of J_m (2, P) with the derivatives J by the points to H_mp (3, P)."""
    for k in range(J_m.shape[1]):
        first, second = J_m[0, k], J_m[1, k]
        H_mp[0, k] += first * J[0, 0, k] + second * J[0, 1, k]
        H_mp[1, k] += first * J[1, 0, k] + second * J[1, 1, k]
        H_mp[2, k] += first * J[2, 0, k] + second * J[2, 1, k]


@compiled
def retract(state: State, pose_step: np.ndarray, point_step: np.ndarray) -> State:
    """Return the state after steps (POSE (F - fixed),) of free frames and (3, P) of points."""
    rotations, translations = state.rotations.copy(), state.translations.copy()
    first = len(rotations) - len(pose_step) // POSE
    for frame in range(first, len(rotations)):
        R, change = rotations[frame], pose_step[POSE * (frame - first):]
        for a in range(3):
            translations[frame, a] += (R[a, 0] * change[3] + R[a, 1] * change[4]
                                       + R[a, 2] * change[5])
        _rotate_in_place(R, change[0], change[1], change[2])
    points = state.points + point_step
    for k in range(points.shape[1]):
        points[2, k] = max(points[2, k], MIN_INVERSE_DEPTH)
    return State(rotations, translations, points)


@compiled
def _rotate_in_place(R: np.ndarray, w0: float, w1: float, w2: float) -> None:
    """Replace R by R exp(w), row by row (Rodrigues)."""
    half = 0.5 * math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    sinc = math.sin(half) / half if half > 0.0 else 1.0
    stay, across = math.cos(2.0 * half), sinc * math.cos(half)
    for a in range(3):
        x, y, z = R[a, 0], R[a, 1], R[a, 2]
        along = 0.5 * sinc * sinc * (w0 * x + w1 * y + w2 * z)
        R[a, 0] = stay * x + across * (y * w2 - z * w1) + along * w0
        R[a, 1] = stay * y + across * (z * w0 - x * w2) + along * w1
        R[a, 2] = stay * z + across * (x * w1 - y * w0) + along * w2
