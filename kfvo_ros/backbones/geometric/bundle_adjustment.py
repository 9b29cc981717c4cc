# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt over the poses and points of one window, compiled.

Derivatives are taken for R <- R exp(w), t <- t + R d of the poses, and for the points as they are.
The first frames of a window may be fixed; the others are free.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kfvo_ros.backbones.geometric.numba_utils import compiled
from kfvo_ros.backbones.geometric.reprojection import (
    MIN_DEPTH,
    NormalEquations,
    Problem,
    State,
    cost,
    lift,
    project,
    seen_by,
)
from kfvo_ros.backbones.geometric.schur import add_products, dot, step

FIRST_DAMPING, LEAST_DAMPING = 1e-4, 1e-7
DAMPING_DOWN, DAMPING_UP = 0.2, 8.0
MAX_REJECTIONS = 5
"""Steps that may fail in a row before the estimate is taken for a minimum."""
MIN_IMPROVEMENT = 1e-3
"""A step that lowers the cost by a smaller share is the last one."""
LEAST_INVERSE_DEPTH = 1e-4
"""Farther points are as far as that: ten thousand times as far as the first scene."""
POSE, LENS, POINT = 6, 5, 3
"""So many numbers each: what a residual depends on, in the order of its derivatives."""
WIDE_ANGLE = 2.0
"""|x|^2 ends here, 55 degrees off the axis: at the rim of a fisheye a lens that is a little
wrong would be wrong beyond reason."""


@compiled
def _weigh(problem: Problem, j: int, view: np.ndarray) -> None:
    """Fill view[5], the focal length times certainty and the root of the weight in the loss.

    The residuals are multiplied by that root; it is 0 for what is unseen or behind.
    """
    reach, mask = problem.width ** 2, problem.mask[j]
    for k in range(view.shape[1]):
        e0, e1 = view[3, k], view[4, k]
        root = math.sqrt(reach / (reach + e0 * e0 + e1 * e1))
        root = root if mask[k] and view[2, k] < 1.0 / MIN_DEPTH else 0.0
        view[3, k], view[4, k] = root * e0, root * e1
        view[5, k] = root * problem.certainty[k] * problem.focal


@compiled
def _differentiate_by_pose(points: np.ndarray, view: np.ndarray, J: np.ndarray) -> None:
    """Fill J (POSE, 2, P), the derivatives of the weighed residuals by the pose of their frame."""
    for k in range(view.shape[1]):
        u, v, focal = view[0, k], view[1, k], view[5, k]
        J[0, 0, k], J[0, 1, k] = focal * u * v, focal * (1.0 + v * v)
        J[1, 0, k], J[1, 1, k] = -focal * (1.0 + u * u), -focal * u * v
        J[2, 0, k], J[2, 1, k] = focal * v, -focal * u
    for k in range(view.shape[1]):
        moved = view[5, k] * view[2, k] * points[2, k]
        J[3, 0, k], J[3, 1, k] = -moved, 0.0
        J[4, 0, k], J[4, 1, k] = 0.0, -moved
        J[5, 0, k], J[5, 1, k] = moved * view[0, k], moved * view[1, k]


@compiled
def _differentiate_by_lens(view: np.ndarray, J: np.ndarray) -> None:
    """Fill J (LENS, 2, P)."""
    for k in range(view.shape[1]):
        u, v, focal = view[0, k], view[1, k], view[5, k]
        off_axis = min(u * u + v * v, WIDE_ANGLE)
        J[0, 0, k], J[0, 1, k] = focal * u, focal * v
        J[1, 0, k], J[1, 1, k] = off_axis * focal * u, off_axis * focal * v
        J[2, 0, k] = off_axis * off_axis * focal * u
        J[2, 1, k] = off_axis * off_axis * focal * v
        J[3, 0, k], J[3, 1, k] = focal, 0.0
        J[4, 0, k], J[4, 1, k] = 0.0, focal


@compiled
def _differentiate_by_point(R: np.ndarray, t: np.ndarray, slopes: np.ndarray, view: np.ndarray,
                            J: np.ndarray) -> None:
    """Fill J (POINT, 2, P) in a frame at (R, t)."""
    for m in range(POINT):
        t0, t1, t2 = (t[0], t[1], t[2]) if m == 2 else (0.0, 0.0, 0.0)
        for k in range(view.shape[1]):
            a, b, c = slopes[m, 0, k] - t0, slopes[m, 1, k] - t1, slopes[m, 2, k] - t2
            along, focal = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c, view[5, k] * view[2, k]
            across = R[0, 0] * a + R[1, 0] * b + R[2, 0] * c
            down = R[0, 1] * a + R[1, 1] * b + R[2, 1] * c
            J[m, 0, k] = focal * (across - view[0, k] * along)
            J[m, 1, k] = focal * (down - view[1, k] * along)


@compiled
def _add_points(J: np.ndarray, view: np.ndarray, H_pp: np.ndarray, g_p: np.ndarray) -> None:
    """Add what a frame says of points by themselves; J (POINT, 2, P) is by them."""
    for k in range(view.shape[1]):
        x0, x1, y0, y1 = J[0, 0, k], J[0, 1, k], J[1, 0, k], J[1, 1, k]
        r0, r1, e0, e1 = J[2, 0, k], J[2, 1, k], view[3, k], view[4, k]
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
def _add_coupling(J_m: np.ndarray, J: np.ndarray, H_mp: np.ndarray) -> None:
    """Add the products of J_m (2, P) with the derivatives J by the points, (3, P)."""
    for k in range(J_m.shape[1]):
        first, second = J_m[0, k], J_m[1, k]
        H_mp[0, k] += first * J[0, 0, k] + second * J[0, 1, k]
        H_mp[1, k] += first * J[1, 0, k] + second * J[1, 1, k]
        H_mp[2, k] += first * J[2, 0, k] + second * J[2, 1, k]


@compiled
def linearise(problem: Problem, state: State, with_lens: bool,
              precision: type[np.floating[Any]]) -> NormalEquations:
    """Return the normal equations at `state`, priors included; H_cp is in this `precision`.

    With the lens they have LENS rows more, of what is zero now: by what share points lie farther
    off the axis, by what share times r^2 and r^4, r off it, and where the axis is.
    """
    (frames, points), fixed = problem.mask.shape, problem.fixed
    poses = POSE * (frames - fixed)
    size = poses + LENS if with_lens else poses
    H_cc, g_c = np.zeros((size, size)), np.zeros(size)
    H_cp = np.zeros((size, POINT, points), precision)
    H_pp, g_p = np.zeros((6, points)), np.zeros((POINT, points))
    derivatives = POSE + LENS + POINT
    space = np.empty((6 + 2 * derivatives) * points)
    lifted, slopes = lift(problem, state.points)
    for k in range(points):
        H_pp[5, k] = problem.prior_weights[k]
        g_p[2, k] = problem.prior_weights[k] * (state.points[2, k] - problem.prior_values[k])
    for j in range(frames):
        seen = seen_by(problem, j)
        view = space[:6 * seen].reshape(6, seen)
        J = space[6 * points:][:2 * derivatives * seen].reshape(derivatives, 2, seen)
        by_pose, by_lens, by_point = J[:POSE], J[POSE:POSE + LENS], J[POSE + LENS:]
        rows, residuals = J.reshape(derivatives, 2 * seen), view[3:5].reshape(2 * seen)
        project(problem, state, lifted, j, view)
        _weigh(problem, j, view)
        _differentiate_by_point(state.rotations[j], state.translations[j], slopes, view,
                                by_point)
        _add_points(by_point, view, H_pp, g_p)
        pose = POSE * (j - fixed)
        if j >= fixed:
            _differentiate_by_pose(state.points, view, by_pose)
            add_products(rows[:POSE], 1.0, H_cc[pose:pose + POSE, pose:pose + POSE])
            for m in range(POSE):
                g_c[pose + m] = dot(rows[m], residuals)
                _add_coupling(J[m], by_point, H_cp[pose + m])
        if with_lens:
            _differentiate_by_lens(view, by_lens)
            for m in range(POSE, POSE + LENS):
                row = poses + m - POSE
                g_c[row] += dot(rows[m], residuals)
                _add_coupling(J[m], by_point, H_cp[row])
                for n in range(0 if j >= fixed else POSE, m + 1):
                    column = pose + n if n < POSE else poses + n - POSE
                    H_cc[row, column] += dot(rows[m], rows[n])
                    H_cc[column, row] = H_cc[row, column]
    return NormalEquations(H_cc, g_c, H_cp, H_pp, g_p)


@compiled
def _turn(R: np.ndarray, w0: float, w1: float, w2: float) -> None:
    """Make R exp(w) of R in place: its rows v become v exp(w) (Rodrigues)."""
    half = 0.5 * math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    sinc = math.sin(half) / half if half > 0.0 else 1.0
    stay, across = math.cos(2.0 * half), sinc * math.cos(half)
    for a in range(3):
        x, y, z = R[a, 0], R[a, 1], R[a, 2]
        along = 0.5 * sinc * sinc * (w0 * x + w1 * y + w2 * z)
        R[a, 0] = stay * x + across * (y * w2 - z * w1) + along * w0
        R[a, 1] = stay * y + across * (z * w0 - x * w2) + along * w1
        R[a, 2] = stay * z + across * (x * w1 - y * w0) + along * w2


@compiled
def stepped(state: State, pose_step: np.ndarray, point_step: np.ndarray) -> State:
    """Apply a step (POSE (F - fixed),) of the last frames and (3, P) of the points."""
    rotations, translations = state.rotations.copy(), state.translations.copy()
    first = len(rotations) - len(pose_step) // POSE
    for frame in range(first, len(rotations)):
        R, change = rotations[frame], pose_step[POSE * (frame - first):]
        for a in range(3):
            translations[frame, a] += (R[a, 0] * change[3] + R[a, 1] * change[4]
                                       + R[a, 2] * change[5])
        _turn(R, change[0], change[1], change[2])
    points = state.points + point_step
    for k in range(points.shape[1]):
        points[2, k] = max(points[2, k], LEAST_INVERSE_DEPTH)
    return State(rotations, translations, points)


@compiled
def adjust(problem: Problem, state: State, iterations: int) -> State:
    """Return the state of least cost near `state`, in at most so many accepted steps."""
    damping, current = FIRST_DAMPING, cost(problem, state)
    for _ in range(iterations):
        for _ in range(MAX_REJECTIONS):
            normal = linearise(problem, state, False, np.float32)
            candidate = stepped(state, *step(normal, damping))
            candidate_cost = cost(problem, candidate)
            if candidate_cost < current:
                break
            damping *= DAMPING_UP
        else:
            return state
        improvement = 1.0 - candidate_cost / current
        state, current = candidate, candidate_cost
        damping = max(damping * DAMPING_DOWN, LEAST_DAMPING)
        if improvement < MIN_IMPROVEMENT:
            break
    return state
