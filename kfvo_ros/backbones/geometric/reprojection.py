# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment problem: measurements, unknowns and robust reprojection cost; compiled.

A point is a ray and an inverse depth in its host, the first frame that observes it. The data are
named tuples, which compiled functions accept.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types

from kfvo_ros.backbones.geometric.numba_utils import compiled, entry_point

MIN_DEPTH = 1e-3
"""A point nearer than this share of its host depth, or behind the camera, has no residual ..."""
BEHIND_ERROR = 100.0
"""... and an error of this size [px]."""


class Problem(NamedTuple):
    """Measurements in a window of F frames and P points.

    ``hosts`` (P,) are indices of host frames and ``origins`` (F, 4, 4) the poses T_anchor_frame
    that points are relative to; ``image_points`` (F, 2, P) under ``mask`` (F, P) are normalised
    and undistorted; ``focal`` [px]. The first ``fixed`` frames are constant. ``certainty`` (P,)
    weighs a point's residuals; ``prior_weights`` (P,) [px^2 per unit squared] draw its inverse
    depth to ``prior_values`` (P,). ``width`` [px] is the scale of Cauchy's loss.
    """

    hosts: np.ndarray
    origins: np.ndarray
    image_points: np.ndarray
    mask: np.ndarray
    focal: float
    fixed: int
    certainty: np.ndarray
    prior_weights: np.ndarray
    prior_values: np.ndarray
    width: float

    def select_points(self, selected: np.ndarray) -> Problem:
        """Return the problem of the points under a mask (P,)."""
        return self._replace(hosts=self.hosts[selected],
                             image_points=np.ascontiguousarray(self.image_points[:, :, selected]),
                             mask=np.ascontiguousarray(self.mask[:, selected]),
                             certainty=self.certainty[selected],
                             prior_weights=self.prior_weights[selected],
                             prior_values=self.prior_values[selected])


class State(NamedTuple):
    """Unknowns of a window: poses of frames in the anchor and points in their origins.

    ``rotations`` (F, 3, 3), ``translations`` (F, 3); ``points`` (3, P) are x, y, inverse depth.
    """

    rotations: np.ndarray
    translations: np.ndarray
    points: np.ndarray

    def select_points(self, selected: np.ndarray) -> State:
        """Return the state of all frames and of the points under a mask (P,)."""
        return self._replace(points=np.ascontiguousarray(self.points[:, selected]))

    def scaled(self, factor: float) -> State:
        """Return the state in another unit of length, for origins in the same unit."""
        return State(self.rotations, self.translations * factor,
                     self.points / np.array([[1.0], [1.0], [factor]]))


class NormalEquations(NamedTuple):
    """Gauss-Newton Hessian and gradient of half the cost, in blocks for cameras and points.

    With C = 6 (F - fixed), ``H_cc`` (C, C) and ``g_c`` (C,) belong to the poses (rotation, then
    translation, of each free frame), ``H_pp`` (6, P), lower triangles by rows, and ``g_p``
    (3, P) to the points; ``H_cp`` (C, 3, P) couples them. Errors of the intrinsics, where they
    are unknowns too, follow the poses in C.
    """

    H_cc: np.ndarray
    g_c: np.ndarray
    H_cp: np.ndarray
    H_pp: np.ndarray
    g_p: np.ndarray


def _named_tuple_type(named_tuple: type, *fields: Any) -> Any:
    """Return the numba type of a NamedTuple class with fields of these types."""
    return types.NamedTuple(fields, named_tuple)


PROBLEM = _named_tuple_type(Problem, int64[::1], float64[:, :, ::1], float64[:, :, ::1],
                            boolean[:, ::1], float64, int64, float64[::1], float64[::1],
                            float64[::1], float64)
STATE = _named_tuple_type(State, float64[:, :, ::1], float64[:, ::1], float64[:, ::1])
NORMAL_EQUATIONS = _named_tuple_type(NormalEquations, float64[:, ::1], float64[::1],
                                     float64[:, :, ::1], float64[:, ::1], float64[:, ::1])


@compiled
def homogeneous_positions(problem: Problem, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return X r (3, P), with X in the anchor, of points x, y, r (3, P), and derivatives.

    The derivatives (3, 3, P) are by x, y and r first.
    """
    positions, slopes = np.empty(points.shape), np.empty((3, 3, points.shape[1]))
    for k in range(points.shape[1]):
        origin = problem.origins[problem.hosts[k]]
        for a in range(3):
            by_x, by_y, by_r = origin[a, 0], origin[a, 1], origin[a, 3]
            slopes[0, a, k], slopes[1, a, k], slopes[2, a, k] = by_x, by_y, by_r
            positions[a, k] = (by_x * points[0, k] + by_y * points[1, k] + origin[a, 2]
                               + by_r * points[2, k])
    return positions, slopes


@compiled
def observed_end(problem: Problem, j: int) -> int:
    """Return the index after the last point that frame j observes.

    Points are ordered by birth, so this skips the later half of them for old frames.
    """
    end = problem.mask.shape[1]
    while end > 0 and not problem.mask[j, end - 1]:
        end -= 1
    return end


@compiled
def project(problem: Problem, state: State, positions: np.ndarray, j: int,
            projection: np.ndarray) -> None:
    """Fill projection[:5], its first points in frame j: p_xy / p_z, 1 / p_z, residuals [px].

    `positions` (3, P) are homogeneous.
    """
    R, t = state.rotations[j], state.translations[j]
    for k in range(projection.shape[1]):
        r = state.points[2, k]
        a = positions[0, k] - r * t[0]
        b = positions[1, k] - r * t[1]
        c = positions[2, k] - r * t[2]
        near = 1.0 / max(R[0, 2] * a + R[1, 2] * b + R[2, 2] * c, MIN_DEPTH)
        u = (R[0, 0] * a + R[1, 0] * b + R[2, 0] * c) * near
        v = (R[0, 1] * a + R[1, 1] * b + R[2, 1] * c) * near
        projection[0, k], projection[1, k], projection[2, k] = u, v, near
        focal = problem.certainty[k] * problem.focal
        projection[3, k] = focal * (u - problem.image_points[j, 0, k])
        projection[4, k] = focal * (v - problem.image_points[j, 1, k])


@entry_point(PROBLEM, STATE)
def errors(problem: Problem, state: State) -> np.ndarray:
    """Return weighted errors (F, P) [px]: 0 without observation, BEHIND_ERROR behind a camera."""
    frames, points = problem.mask.shape
    positions, _ = homogeneous_positions(problem, state.points)
    workspace, lengths = np.empty(5 * points), np.zeros((frames, points))
    for j in range(frames):
        count = observed_end(problem, j)
        projection = workspace[:5 * count].reshape(5, count)
        project(problem, state, positions, j, projection)
        for k in range(count):
            length = math.sqrt(projection[3, k] * projection[3, k]
                               + projection[4, k] * projection[4, k])
            length = length if projection[2, k] < 1.0 / MIN_DEPTH else BEHIND_ERROR
            lengths[j, k] = length if problem.mask[j, k] else 0.0
    return lengths


@entry_point(PROBLEM, STATE)
def cost(problem: Problem, state: State) -> float:
    """Return the cost [px^2]: Cauchy's loss of observations plus squared errors of priors."""
    lengths, squared_width = errors(problem, state), problem.width ** 2
    (frames, points), total = lengths.shape, 0.0
    products = np.ones(points)  # Their logarithms are the sums of logarithms.
    for j in range(frames):
        for k in range(observed_end(problem, j)):
            products[k] *= 1.0 + lengths[j, k] * lengths[j, k] / squared_width
    for k in range(points):
        away = state.points[2, k] - problem.prior_values[k]
        total += squared_width * math.log(products[k]) + problem.prior_weights[k] * away * away
    return total
