# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt over the poses and hosted inverse depths of one window, compiled.

A point is an inverse depth r along the ray b = (x, y, 1) through its pixel in its *host*, the
first frame of the window that sees it. With poses T_anchor_frame = (R, t), hosted in h and seen
in j, the point lies in j along

    p = turn b + r shift,  turn = R_j^T R_h,  shift = R_j^T (t_h - t_j),

its residual is focal (p_xy / p_z - seen_xy) [px], and derivatives are taken for R <- R exp(w),
t <- t + d. The first frames of a window may be fixed; those that are not are free.

What is compiled here calls nothing of other files: the compiler's cache would not see them change.
"""

from __future__ import annotations

import math

import numpy as np

from kfvo_ros.backbones.geometric.compilation import compiled
from kfvo_ros.backbones.geometric.problem import NormalEquations, Problem, State

HUBER = 0.8
"""Reprojection errors beyond it count linearly [px]."""
MIN_DEPTH = 1e-3
"""A point nearer than this share of its host depth, or behind, has no residual ..."""
BEHIND_ERROR = 100.0
"""... and counts as this many pixels off."""
FIRST_DAMPING, LEAST_DAMPING = 1e-4, 1e-7
DAMPING_DOWN, DAMPING_UP = 0.2, 8.0
MAX_REJECTIONS = 5
"""Steps that may fail in a row before the estimate is taken for a minimum."""
MIN_IMPROVEMENT = 1e-3
"""A step that lowers the cost by a smaller share is the last one."""
LEAST_INVERSE_DEPTH = 1e-4
TINY = 1e-9
RESIDUAL = 6
"""Column of J after rotation (3) and shift (3) of the seeing frame, before the host's rotation;
its shift changes the residual as that of the seeing frame does, in the opposite direction."""


@compiled
def between(state: State) -> tuple[np.ndarray, np.ndarray]:
    """Return turns (F, F, 3, 3) and shifts (F, F, 3) from hosts to themselves and later frames."""
    R, t, frames = state.rotations, state.translations, len(state.rotations)
    turns, shifts = np.zeros((frames, frames, 3, 3)), np.zeros((frames, frames, 3))
    for h in range(frames):
        for j in range(h, frames):
            for a in range(3):
                for b in range(3):
                    into, away = R[j, b, a], t[h, b] - t[j, b]
                    shifts[h, j, a] += into * away
                    for c in range(3):
                        turns[h, j, a, c] += into * R[h, b, c]
    return turns, shifts


@compiled
def _into_frame(turn: np.ndarray, shift: np.ndarray, ray: np.ndarray,
                r: float) -> tuple[float, float, float]:
    """Return p of the module's docstring."""
    return (turn[0, 0] * ray[0] + turn[0, 1] * ray[1] + turn[0, 2] * ray[2] + r * shift[0],
            turn[1, 0] * ray[0] + turn[1, 1] * ray[1] + turn[1, 2] * ray[2] + r * shift[1],
            turn[2, 0] * ray[0] + turn[2, 1] * ray[1] + turn[2, 2] * ray[2] + r * shift[2])


@compiled
def reprojection_errors(problem: Problem, state: State) -> np.ndarray:
    """Return errors (P, F) [px]: 0 where unseen or hosted, BEHIND_ERROR behind a camera."""
    points, frames = problem.mask.shape
    turns, shifts = between(state)
    errors = np.zeros((points, frames))
    for k in range(points):
        h, r = problem.hosts[k], state.inverse_depths[k]
        for j in range(h + 1, frames):
            if problem.mask[k, j]:
                x, y, z = _into_frame(turns[h, j], shifts[h, j], problem.rays[k], r)
                e0 = problem.focal * (x / z - problem.seen[k, j, 0])
                e1 = problem.focal * (y / z - problem.seen[k, j, 1])
                errors[k, j] = math.sqrt(e0 * e0 + e1 * e1) if z >= MIN_DEPTH else BEHIND_ERROR
    return errors


@compiled
def cost(problem: Problem, state: State) -> float:
    """Return the Huber cost [px^2] of observations and priors."""
    errors = reprojection_errors(problem, state)
    total = 0.0
    for k in range(len(errors)):
        for error in errors[k]:
            quadratic = min(error, HUBER)
            total += quadratic * (2.0 * error - quadratic)
        away = state.inverse_depths[k] - problem.prior_values[k]
        total += problem.prior_weights[k] * away * away
    return total


@compiled
def _differentiate(rotation: np.ndarray, turn: np.ndarray, ray: np.ndarray, r: float,
                   focal: float, p: tuple[float, float, float], J: np.ndarray) -> None:
    """Fill the derivatives of a residual, J (2, 10) but for the column RESIDUAL."""
    x, y, z = p
    for a in range(2):
        # d residual_a / d p = (across, 0, along) or (0, across, along), here turned back.
        across, along = focal / z, -focal * p[a] / (z * z)
        a0, a1 = (across, 0.0) if a == 0 else (0.0, across)
        J[a, 0], J[a, 1], J[a, 2] = a1 * z - along * y, along * x - a0 * z, a0 * y - a1 * x
        for b in range(3):
            J[a, 3 + b] = -r * (across * rotation[b, a] + along * rotation[b, 2])
        v0 = across * turn[a, 0] + along * turn[2, 0]
        v1 = across * turn[a, 1] + along * turn[2, 1]
        v2 = across * turn[a, 2] + along * turn[2, 2]
        J[a, 7] = v2 * ray[1] - v1 * ray[2]
        J[a, 8] = v0 * ray[2] - v2 * ray[0]
        J[a, 9] = v1 * ray[0] - v0 * ray[1]


@compiled
def _accumulate(J: np.ndarray, d0: float, d1: float, weight: float, h: int, j: int,
                products: np.ndarray, H_cp: np.ndarray, k: int) -> None:
    """Add what free frame j sees of point k, hosted in h, < 0 if fixed; d is by its depth."""
    product, width = products[max(h + 1, 0), j], 10 if h >= 0 else 7
    for m in range(width):
        w0, w1 = weight * J[0, m], weight * J[1, m]
        for n in range(width):
            product[m, n] += w0 * J[0, n] + w1 * J[1, n]
    for m in range(6):
        coupling = weight * (J[0, m] * d0 + J[1, m] * d1)
        H_cp[6 * j + m, k] = coupling
        if h >= 0 and m < 3:
            H_cp[6 * h + m, k] += weight * (J[0, 7 + m] * d0 + J[1, 7 + m] * d1)
        elif h >= 0:
            H_cp[6 * h + m, k] -= coupling


@compiled
def _gather(products: np.ndarray, H_cc: np.ndarray, g_c: np.ndarray) -> None:
    """Add the sums of J^T J by host and seeing frame to the equations of the poses."""
    hosts, seeing, _, _ = products.shape
    for h in range(-1, hosts - 1):
        for j in range(seeing):
            product = products[h + 1, j]
            for m in range(6):
                row, column, sign = 6 * h + m, 7 + m if m < 3 else m, 1.0 if m < 3 else -1.0
                g_c[6 * j + m] += product[m, RESIDUAL]
                for n in range(6):
                    H_cc[6 * j + m, 6 * j + n] += product[m, n]
                if h < 0:
                    continue
                g_c[row] += sign * product[column, RESIDUAL]
                for n in range(6):
                    coupling = sign * product[column, n]
                    H_cc[row, 6 * j + n] += coupling
                    H_cc[6 * j + n, row] += coupling
                    H_cc[row, 6 * h + n] += sign * product[column, 7 + n] if n < 3 else -coupling


@compiled
def linearise(problem: Problem, state: State) -> NormalEquations:
    """Return the normal equations at `state`, priors included."""
    (points, frames), fixed, focal = problem.mask.shape, problem.fixed, problem.focal
    free = frames - fixed
    H_cp, H_pp, g_p = np.zeros((6 * free, points)), np.zeros(points), np.zeros(points)
    J, products = np.zeros((2, 10)), np.zeros((free + 1, free, 10, 10))
    turns, shifts = between(state)
    for k in range(points):
        h, ray, r = problem.hosts[k], problem.rays[k], state.inverse_depths[k]
        H_pp[k] = problem.prior_weights[k]
        g_p[k] = problem.prior_weights[k] * (r - problem.prior_values[k])
        for j in range(h + 1, frames):
            if not problem.mask[k, j]:
                continue
            turn, shift = turns[h, j], shifts[h, j]
            p = _into_frame(turn, shift, ray, r)
            if p[2] < MIN_DEPTH:
                continue
            u, v = p[0] / p[2], p[1] / p[2]
            e0, e1 = focal * (u - problem.seen[k, j, 0]), focal * (v - problem.seen[k, j, 1])
            error = math.sqrt(e0 * e0 + e1 * e1)
            weight = 1.0 if error < HUBER else HUBER / error
            d0 = focal * (shift[0] - shift[2] * u) / p[2]
            d1 = focal * (shift[1] - shift[2] * v) / p[2]
            H_pp[k] += weight * (d0 * d0 + d1 * d1)
            g_p[k] += weight * (d0 * e0 + d1 * e1)
            if j >= fixed:
                _differentiate(state.rotations[j], turn, ray, r, focal, p, J)
                J[0, RESIDUAL], J[1, RESIDUAL] = e0, e1
                _accumulate(J, d0, d1, weight, h - fixed, j - fixed, products, H_cp, k)
    H_cc, g_c = np.zeros((6 * free, 6 * free)), np.zeros(6 * free)
    _gather(products, H_cc, g_c)
    return NormalEquations(H_cc, g_c, H_cp, H_pp, g_p)


@compiled
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled
def reduce(normal: NormalEquations, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Eliminate the depths (Schur complement); return system and gradient of the poses."""
    H_cc, g_c, H_cp, H_pp, g_p = normal
    size, points = H_cp.shape
    system, gradient, eliminated = H_cc.copy(), g_c.copy(), np.empty(points)
    for row in range(size):
        system[row, row] += damping * H_cc[row, row] + TINY
        for k in range(points):
            eliminated[k] = H_cp[row, k] / (H_pp[k] * (1.0 + damping) + TINY)
        gradient[row] -= _dot(eliminated, g_p)
        for column in range(row, size):
            system[row, column] -= _dot(eliminated, H_cp[column])
            system[column, row] = system[row, column]
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
    """Return the damped Gauss-Newton step of free poses (C,) and inverse depths (P,)."""
    poses = -_solve(*reduce(normal, damping))
    pull = normal.g_p.copy()
    for row in range(len(poses)):
        for k in range(len(pull)):
            pull[k] += normal.H_cp[row, k] * poses[row]
    return poses, -pull / (normal.H_pp * (1.0 + damping) + TINY)


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
def stepped(state: State, pose_step: np.ndarray, depth_step: np.ndarray) -> State:
    """Apply a step (6 (F - fixed),) of the last frames and (P,)."""
    rotations, translations = state.rotations.copy(), state.translations.copy()
    first = len(rotations) - len(pose_step) // 6
    for frame in range(first, len(rotations)):
        place = 6 * (frame - first)
        _turn(rotations[frame], pose_step[place], pose_step[place + 1], pose_step[place + 2])
        for axis in range(3):
            translations[frame, axis] += pose_step[place + 3 + axis]
    return State(rotations, translations,
                 np.maximum(state.inverse_depths + depth_step, LEAST_INVERSE_DEPTH))


@compiled
def adjust(problem: Problem, state: State, iterations: int) -> State:
    """Return the state of least cost near `state`, in at most so many accepted steps."""
    damping = FIRST_DAMPING
    current = cost(problem, state)
    for _ in range(iterations):
        normal = linearise(problem, state)
        for _ in range(MAX_REJECTIONS):
            poses, depths = step(normal, damping)
            candidate = stepped(state, poses, depths)
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
