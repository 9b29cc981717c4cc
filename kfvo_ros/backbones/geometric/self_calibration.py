# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Self-calibration: a Kalman filter of the errors of the calibrated intrinsics.

Rectified datasets and quick calibrations are a few pixels off, at the image border or everywhere.
Within a window this disappears in the noise, but it is the same in all windows: scale drifts along
streets and jumps in turns. Each solved window is therefore a measurement of the errors, weighed
against earlier ones and the calibration. Windows in turns contribute most, so they are used at a
high rate. The model must cover every large error of a lens; otherwise the focal length absorbs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numba import float64

from kfvo_ros.backbones.geometric.bundle_adjustment import (
    INTRINSICS,
    MAX_SQUARED_RADIUS,
    linearise,
)
from kfvo_ros.backbones.geometric.numba_utils import entry_point
from kfvo_ros.backbones.geometric.reprojection import Problem, State
from kfvo_ros.backbones.geometric.schur import marginalise_points
from kfvo_ros.camera import Camera

CALIBRATION_SIGMAS = (0.005, 0.005, 0.001, 0.001, 0.001)
"""Standard deviations of a calibration's errors: e0, e1 and e2 as in `IntrinsicsFilter` [share of
the radius at 45 degrees off the axis], then the principal point [focal lengths]."""
MIN_NEW_SHARE = 0.25
"""Least share of new frames in a window for an update; its information is scaled by the share."""
MIN_TRACK_LENGTH = 4
"""Tracks with fewer observations in a window add little beyond their own unknowns."""
ERROR_CORRELATION = 0.7
"""Correlation of a track's errors in successive frames; g frames apart it is this power g.
Correlated errors carry less information, most of all where every frame is a keyframe."""
CONVERGED_SIGMA_RATIO = 0.5
"""The focal length is published below this share of its calibration sigma."""


@entry_point(float64[:, ::1], float64[::1])
def undistort_points(points: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return points (N, 2) corrected by intrinsics errors (INTRINSICS,) of `IntrinsicsFilter`."""
    corrected = np.empty(points.shape)
    for k in range(len(points)):
        x, y = points[k]
        r2 = min(x * x + y * y, MAX_SQUARED_RADIUS)
        longer = 1.0 + errors[0] + errors[1] * r2 + errors[2] * r2 * r2
        corrected[k, 0], corrected[k, 1] = (x - errors[3]) / longer, (y - errors[4]) / longer
    return corrected


def _calibration_information() -> np.ndarray:
    return np.diag(1.0 / np.square(CALIBRATION_SIGMAS))


@dataclass(frozen=True)
class IntrinsicsFilter:
    """Estimate of the errors: a calibrated point x is (x - c) / (1 + e0 + e1 r^2 + e2 r^4).

    ``errors`` (5,) are e and the principal point's c, with ``information`` (5, 5); r is the
    distance off the axis; ``last_frame`` is the index of the newest frame that was used.
    """

    errors: np.ndarray = field(default_factory=lambda: np.zeros(len(CALIBRATION_SIGMAS)))
    information: np.ndarray = field(default_factory=_calibration_information)
    last_frame: int = -1

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """Return normalised points (N, 2) without the estimated errors."""
        return undistort_points(points, self.errors)

    def new_share(self, indices: Sequence[int]) -> float:
        """Return the share of a window's frames, by index, that were not used yet."""
        return sum(index > self.last_frame for index in indices) / len(indices)

    @cached_property
    def converged(self) -> bool:
        """Whether the focal length is known much better than from the calibration."""
        variance = np.linalg.inv(self.information)[0, 0]
        return bool(variance < (CONVERGED_SIGMA_RATIO * CALIBRATION_SIGMAS[0]) ** 2)

    def intrinsics(self, camera: Camera) -> np.ndarray:
        """Return the estimated K (3, 3) [px], valid near the axis, of a calibrated camera."""
        larger, (x, y) = 1.0 + self.errors[0], self.errors[-2:]
        return camera.matrix @ [[larger, 0.0, x], [0.0, larger, y], [0.0, 0.0, 1.0]]

    def update(self, problem: Problem, state: State, noise: float,
               indices: Sequence[int]) -> IntrinsicsFilter:
        """Return the filter after the measurement of a solved window, undistorted by this one.

        `noise` [px] is that of its tracks, `indices` are those of its frames.
        """
        information, vector = marginal_information(problem, state)
        correlation = ERROR_CORRELATION ** ((indices[-1] - indices[0]) / (len(indices) - 1))
        variance = (noise ** 2 * (1.0 + correlation) / (1.0 - correlation)
                    / self.new_share(indices))
        total = self.information + information / variance
        return IntrinsicsFilter(self.errors + np.linalg.solve(total, vector / variance), total,
                                indices[-1])


def marginal_information(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Return information matrix (5, 5) and vector (5,) of the intrinsics errors, for 1 px noise.

    Only long tracks are used. All frames but the first are free and marginalised; depth priors
    hold the scale. The most likely errors are matrix^-1 @ vector.
    """
    long = problem.mask.sum(axis=0) >= MIN_TRACK_LENGTH
    free = problem.select_points(long)._replace(fixed=1)
    system, gradient = marginalise_points(
        linearise(free, state.select_points(long), True, np.float64))
    poses, errors = slice(0, -INTRINSICS), slice(-INTRINSICS, None)
    right = np.column_stack([system[poses, errors], gradient[poses]])
    eliminated = system[errors, poses] @ np.linalg.solve(system[poses, poses], right)
    return system[errors, errors] - eliminated[:, :-1], eliminated[:, -1] - gradient[errors]
