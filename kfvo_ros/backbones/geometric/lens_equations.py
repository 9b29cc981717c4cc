# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What one solved window says of the lens, all else in it set free; compiled.

A window's adjustment takes a point's ray in its host for exact. Here that noise would be laid to
the lens, so a point is all its three numbers: inverse depth r and the ray b = (b_x, b_y, 1) in
its host. With p as in bundle_adjustment, its residual in every frame that sees it, the host among
them, is

    focal (x (1 + basis(x) @ errors) - seen) [px],  x = p_xy / p_z,  basis(x) = (1, |x|^2),

linearised at errors = 0. Poses are moved in their own axes, T <- T exp(w, d); nothing is wanted
of them but their freedom.

What is compiled here calls nothing of other files: the compiler's cache would not see them change.
"""

from __future__ import annotations

import numpy as np

from kfvo_ros.backbones.geometric import bundle_adjustment as ba
from kfvo_ros.backbones.geometric.compilation import compiled
from kfvo_ros.backbones.geometric.problem import Problem, State

LENS, POSE, POINT = 2, 6, 3
SEEING, HOST, HERE = LENS, LENS + POSE, LENS + 2 * POSE
"""Columns of J where seeing frame, host and point begin; those of the lens come first."""
FAR = 2.0
"""|x|^2 ends here, 55 degrees off the axis: at the rim of a fisheye it would be beyond reason."""
TINY = 1e-9


@compiled
def basis(points: np.ndarray) -> np.ndarray:
    """Return by what share each error of the lens moves points (N, 2) off the axis, (N, 2)."""
    shares = np.ones((len(points), LENS))
    for k in range(len(points)):
        shares[k, 1] = min(points[k, 0] ** 2 + points[k, 1] ** 2, FAR)
    return shares


def marginal(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Return information (2, 2) on the errors of the lens, and its pull (2,) on them.

    Both are for tracks off by 1 px; the errors are most likely information^-1 @ pull.
    """
    errors = ba.reprojection_errors(problem, state)
    weights = ba.HUBER / np.maximum(errors, ba.HUBER)
    weights[~problem.mask | (errors >= ba.BEHIND_ERROR)] = 0.0
    H, g, H_point, g_point, coupling = _accumulate(problem, state, *ba.between(state), weights)
    right = np.concatenate([coupling.transpose(0, 2, 1), g_point[:, :, None]], axis=2)
    eliminated = np.tensordot(coupling, np.linalg.solve(H_point, right), axes=((0, 2), (0, 1)))
    system = np.column_stack([H, g]) - eliminated
    # The first frame stays; scale is held by what is expected of the depths.
    lens, poses = system[:LENS], system[LENS + POSE:]
    H_poses = poses[:, LENS + POSE:-1]
    H_poses[np.diag_indices_from(H_poses)] += TINY * (1.0 + H_poses.diagonal())
    sought = np.r_[:LENS, len(H)]
    lens = lens[:, sought] - lens[:, LENS + POSE:-1] @ np.linalg.solve(H_poses, poses[:, sought])
    return lens[:, :LENS], -lens[:, -1]


@compiled
def _differentiate(turn: np.ndarray, shift: np.ndarray, ray: np.ndarray, r: float,
                   p: tuple[float, float, float], focal: float, J: np.ndarray) -> None:
    """Fill the derivatives of a residual, J (2, 17)."""
    x, y, z = p
    off_axis = min((x * x + y * y) / (z * z), FAR)
    for a in range(2):
        # d residual_a / d p = A = (across, 0, along) or (0, across, along); B is A in the host.
        across, along = focal / z, -focal * p[a] / (z * z)
        a0, a1 = (across, 0.0) if a == 0 else (0.0, across)
        b0 = a0 * turn[0, 0] + a1 * turn[1, 0] + along * turn[2, 0]
        b1 = a0 * turn[0, 1] + a1 * turn[1, 1] + along * turn[2, 1]
        b2 = a0 * turn[0, 2] + a1 * turn[1, 2] + along * turn[2, 2]
        J[a, 0] = focal * p[a] / z
        J[a, 1] = off_axis * J[a, 0]
        # The seeing frame: A x p, -r A.
        J[a, SEEING], J[a, SEEING + 1] = a1 * z - along * y, along * x - a0 * z
        J[a, SEEING + 2] = a0 * y - a1 * x
        J[a, SEEING + 3], J[a, SEEING + 4], J[a, SEEING + 5] = -r * a0, -r * a1, -r * along
        # The host: b x B, r B.
        J[a, HOST], J[a, HOST + 1] = ray[1] * b2 - b1, b0 - ray[0] * b2
        J[a, HOST + 2] = ray[0] * b1 - ray[1] * b0
        J[a, HOST + 3], J[a, HOST + 4], J[a, HOST + 5] = r * b0, r * b1, r * b2
        J[a, HERE], J[a, HERE + 1] = b0, b1
        J[a, HERE + 2] = a0 * shift[0] + a1 * shift[1] + along * shift[2]


@compiled
def _accumulate(problem: Problem, state: State, turns: np.ndarray, shifts: np.ndarray,
                weights: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return H, g of lens and poses, H_point, g_point of each point, and what couples them."""
    points, frames = weights.shape
    size = LENS + POSE * frames
    H, g, coupling = np.zeros((size, size)), np.zeros(size), np.zeros((points, size, POINT))
    H_point, g_point = np.zeros((points, POINT, POINT)), np.zeros((points, POINT))
    J, rows = np.zeros((2, HERE + POINT)), np.zeros(HERE, dtype=np.int64)
    rows[1] = 1
    for k in range(points):
        h, ray, r = problem.hosts[k], problem.rays[k], state.inverse_depths[k]
        for n in range(POINT):
            H_point[k, n, n] = TINY
        H_point[k, 2, 2] += problem.prior_weights[k]
        g_point[k, 2] = problem.prior_weights[k] * (r - problem.prior_values[k])
        for n in range(POSE):
            rows[HOST + n] = LENS + POSE * h + n
        for j in range(h, frames):
            weight = weights[k, j]
            if weight == 0.0:
                continue
            turn, shift = turns[h, j], shifts[h, j]
            p = (turn[0, 0] * ray[0] + turn[0, 1] * ray[1] + turn[0, 2] + r * shift[0],
                 turn[1, 0] * ray[0] + turn[1, 1] * ray[1] + turn[1, 2] + r * shift[1],
                 turn[2, 0] * ray[0] + turn[2, 1] * ray[1] + turn[2, 2] + r * shift[2])
            _differentiate(turn, shift, ray, r, p, problem.focal, J)
            for n in range(POSE):
                rows[SEEING + n] = LENS + POSE * j + n
            for a in range(2):
                e = problem.focal * (p[a] / p[2] - problem.seen[k, j, a])
                for m in range(HERE):
                    slope = weight * J[a, m]
                    g[rows[m]] += slope * e
                    for n in range(HERE):
                        H[rows[m], rows[n]] += slope * J[a, n]
                    for n in range(POINT):
                        coupling[k, rows[m], n] += slope * J[a, HERE + n]
                for m in range(POINT):
                    slope = weight * J[a, HERE + m]
                    g_point[k, m] += slope * e
                    for n in range(POINT):
                        H_point[k, m, n] += slope * J[a, HERE + n]
    return H, g, H_point, g_point, coupling
