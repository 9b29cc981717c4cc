# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a bundle adjustment knows, seeks and solves; named tuples, which compiled code can take."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from kfvo_ros.backbones.geometric.numba_utils import compiled

MIN_DEPTH = 1e-3
"""A point nearer than this share of its host depth, or behind, has no residual ..."""
BEHIND_ERROR = 100.0
"""... and counts as this many pixels off."""


class Problem(NamedTuple):
    """What is measured in a window of F frames and P points.

    ``hosts`` (P,) are the frames that see a point first, ``origins`` (F, 4, 4) where they were
    guessed to be; ``seen`` (F, 2, P) under ``mask`` (F, P), normalised and undistorted; ``focal``
    [px]. The first ``fixed`` frames are not moved. A point's errors count ``certainty`` (P,)
    times; its inverse depth is drawn to ``prior_values`` (P,) with ``prior_weights`` (P,) [px^2
    per unit squared]. Errors that count for well more than ``width`` [px] are let go.
    """

    hosts: np.ndarray
    origins: np.ndarray
    seen: np.ndarray
    mask: np.ndarray
    focal: float
    fixed: int
    certainty: np.ndarray
    prior_weights: np.ndarray
    prior_values: np.ndarray
    width: float

    def of_points(self, chosen: np.ndarray) -> Problem:
        """Return what is measured of some points (P,) alone."""
        return self._replace(hosts=self.hosts[chosen],
                             seen=np.ascontiguousarray(self.seen[:, :, chosen]),
                             mask=np.ascontiguousarray(self.mask[:, chosen]),
                             certainty=self.certainty[chosen],
                             prior_weights=self.prior_weights[chosen],
                             prior_values=self.prior_values[chosen])


class State(NamedTuple):
    """Where frames are in the anchor, and points in their origins.

    ``rotations`` (F, 3, 3), ``translations`` (F, 3); ``points`` (3, P) are x, y, inverse depth.
    """

    rotations: np.ndarray
    translations: np.ndarray
    points: np.ndarray

    def of_points(self, chosen: np.ndarray) -> State:
        """Return the state of some points (P,) alone, and of all frames."""
        return self._replace(points=np.ascontiguousarray(self.points[:, chosen]))

    def scaled(self, factor: float) -> State:
        """Return the same window in another unit, which its origins have to be in too."""
        return State(self.rotations, self.translations * factor,
                     self.points / np.array([[1.0], [1.0], [factor]]))


class NormalEquations(NamedTuple):
    """Gauss-Newton Hessian and gradient of half the cost, points apart from poses.

    With C = 6 (F - fixed), ``H_cc`` (C, C) and ``g_c`` (C,) belong to the poses (rotation, then
    translation, of each free frame), ``H_pp`` (6, P), lower triangles by rows, and ``g_p``
    (3, P) to the points, ``H_cp`` (C, 3, P) couples them. What is asked of the lens too adds its
    rows to C.
    """

    H_cc: np.ndarray
    g_c: np.ndarray
    H_cp: np.ndarray
    H_pp: np.ndarray
    g_p: np.ndarray


@compiled
def lift(problem: Problem, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `lifted` (3, P) of points (3, P), and its derivatives (3, 3, P) by x, y and r."""
    lifted, slopes = np.empty(points.shape), np.empty((3, 3, points.shape[1]))
    for k in range(points.shape[1]):
        origin = problem.origins[problem.hosts[k]]
        for a in range(3):
            by_x, by_y, by_r = origin[a, 0], origin[a, 1], origin[a, 3]
            slopes[0, a, k], slopes[1, a, k], slopes[2, a, k] = by_x, by_y, by_r
            lifted[a, k] = (by_x * points[0, k] + by_y * points[1, k] + origin[a, 2]
                            + by_r * points[2, k])
    return lifted, slopes


@compiled
def seen_by(problem: Problem, j: int) -> int:
    """Return before which point all are that frame j sees: they are in the order of their births.

    Old frames, whose later points need not be looked at, see but half of them.
    """
    end = problem.mask.shape[1]
    while end > 0 and not problem.mask[j, end - 1]:
        end -= 1
    return end


@compiled
def project(problem: Problem, state: State, lifted: np.ndarray, j: int, view: np.ndarray) -> None:
    """Fill what frame j sees of the first points, view[:5]: p_xy / p_z, 1 / p_z, residual."""
    R, t = state.rotations[j], state.translations[j]
    for k in range(view.shape[1]):
        r = state.points[2, k]
        a, b, c = lifted[0, k] - r * t[0], lifted[1, k] - r * t[1], lifted[2, k] - r * t[2]
        near = 1.0 / max(R[0, 2] * a + R[1, 2] * b + R[2, 2] * c, MIN_DEPTH)
        u = (R[0, 0] * a + R[1, 0] * b + R[2, 0] * c) * near
        v = (R[0, 1] * a + R[1, 1] * b + R[2, 1] * c) * near
        view[0, k], view[1, k], view[2, k] = u, v, near
        focal = problem.certainty[k] * problem.focal
        view[3, k] = focal * (u - problem.seen[j, 0, k])
        view[4, k] = focal * (v - problem.seen[j, 1, k])


@compiled
def errors(problem: Problem, state: State) -> np.ndarray:
    """Return what errors (F, P) count for [px]: 0 where unseen, BEHIND_ERROR behind a camera."""
    frames, points = problem.mask.shape
    lifted, _ = lift(problem, state.points)
    space, off = np.empty(5 * points), np.zeros((frames, points))
    for j in range(frames):
        seen = seen_by(problem, j)
        view = space[:5 * seen].reshape(5, seen)
        project(problem, state, lifted, j, view)
        for k in range(seen):
            error = math.sqrt(view[3, k] * view[3, k] + view[4, k] * view[4, k])
            error = error if view[2, k] < 1.0 / MIN_DEPTH else BEHIND_ERROR
            off[j, k] = error if problem.mask[j, k] else 0.0
    return off


@compiled
def cost(problem: Problem, state: State) -> float:
    """Return the cost [px^2] of observations, by Cauchy's loss, and of priors, by squares."""
    off, reach = errors(problem, state), problem.width ** 2
    (frames, points), total = off.shape, 0.0
    products = np.ones(points)  # Their logarithms are the sums of logarithms.
    for j in range(frames):
        for k in range(seen_by(problem, j)):
            products[k] *= 1.0 + off[j, k] * off[j, k] / reach
    for k in range(points):
        away = state.points[2, k] - problem.prior_values[k]
        total += reach * math.log(products[k]) + problem.prior_weights[k] * away * away
    return total
