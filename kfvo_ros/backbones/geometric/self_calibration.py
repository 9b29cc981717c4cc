# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a calibration left of the lens, learnt on the way.

Rectified datasets and hurried calibrations are a few pixels off, at the rim or everywhere. In one
window that hides among the noise, but it is the same in every window: the scale drifts along each
street and jumps in each turn. So solved windows are asked what they say of the lens, again and
again within a turn, for it tells most, and the answers are weighed against each other and against
the calibration: a Kalman filter of something that does not move. Of what is wrong with lenses
nothing large may be left out, or it is laid to the focal length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from kfvo_ros.backbones.geometric import bundle_adjustment as ba
from kfvo_ros.backbones.geometric.numba_utils import compiled
from kfvo_ros.backbones.geometric.reprojection import Problem, State
from kfvo_ros.backbones.geometric.schur import reduce
from kfvo_ros.camera import Camera

EXPECTED = (0.005, 0.005, 0.001, 0.001, 0.001)
"""Standard deviations of a calibration's errors: by this share points lie elsewhere near the axis
and, in addition, at 45 degrees off it, by the square and the fourth power of the distance; and so
many focal lengths the axis lies elsewhere."""
ASKED_AGAIN = 0.25
"""A window is asked once so large a share of its frames is new; it counts by that share."""
LEAST_VIEWS = 4
"""Tracks seen in fewer frames of a window need nearly all that they say for themselves."""
ALIKE = 0.7
"""How a track's errors in two successive frames correlate; g frames apart it is ALIKE^g. Errors
that are alike say less than independent ones would, more so where every frame is a keyframe."""
KNOWN = 0.5
"""A focal length is worth telling once it is this share as doubtful as the calibration's was."""


@compiled
def undistort_points(points, errors):
    """Return where points (N, 2) lie through a lens with these errors (ba.LENS,), see `Lens`."""
    straight = np.empty(points.shape)
    for k in range(len(points)):
        x, y = points[k]
        r2 = min(x * x + y * y, ba.WIDE_ANGLE)
        longer = 1.0 + errors[0] + errors[1] * r2 + errors[2] * r2 * r2
        straight[k, 0], straight[k, 1] = (x - errors[3]) / longer, (y - errors[4]) / longer
    return straight


def _calibrated() -> np.ndarray:
    return np.diag(1.0 / np.square(EXPECTED))


@dataclass(frozen=True)
class IntrinsicsFilter:
    """Points lie at (x - c) / (1 + e0 + e1 r^2 + e2 r^4) where the calibration says x.

    ``errors`` (5,) are e and the axis c, ``information`` (5, 5) is theirs; r is off the axis;
    ``asked`` is the index of the newest view that was asked.
    """

    errors: np.ndarray = field(default_factory=lambda: np.zeros(len(EXPECTED)))
    information: np.ndarray = field(default_factory=_calibrated)
    asked: int = -1

    def straighten(self, points: np.ndarray) -> np.ndarray:
        """Return where points (N, 2) lie, normalised as they are."""
        return undistort_points(points, self.errors)

    def new_in(self, indices: Sequence[int]) -> float:
        """Return the share of a window's frames, by their indices, that were not asked yet."""
        return sum(index > self.asked for index in indices) / len(indices)

    @cached_property
    def known(self) -> bool:
        """Whether more is known of the focal length than the calibration says."""
        variance = np.linalg.inv(self.information)[0, 0]
        return bool(variance < (KNOWN * EXPECTED[0]) ** 2)

    def intrinsics(self, camera: Camera) -> np.ndarray:
        """Return K (3, 3) [px] as it is, near the axis, of a camera with this calibration."""
        larger, (x, y) = 1.0 + self.errors[0], self.errors[-2:]
        return camera.matrix @ [[larger, 0.0, x], [0.0, larger, y], [0.0, 0.0, 1.0]]

    def told(self, problem: Problem, state: State, noise: float, indices: Sequence[int]) -> IntrinsicsFilter:
        """Return what is known after a window, straightened by this lens, has been solved.

        Its tracks are off by `noise` [px]; `indices` are those of its frames.
        """
        information, pull = marginal(problem, state)
        correlation = ALIKE ** ((indices[-1] - indices[0]) / (len(indices) - 1))
        variance = noise ** 2 * (1.0 + correlation) / (1.0 - correlation) / self.new_in(indices)
        known = self.information + information / variance
        return IntrinsicsFilter(self.errors + np.linalg.solve(known, pull / variance), known, indices[-1])


def marginal(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Return information (5, 5) on the errors of the lens, and its pull (5,) on them.

    Both are by the longer tracks, off by 1 px, all else set free but the first frame; the errors
    are most likely information^-1 @ pull. Scale is held by what is expected of depths.
    """
    long = problem.mask.sum(axis=0) >= LEAST_VIEWS
    free = problem.of_points(long)._replace(fixed=1)
    system, gradient = reduce(ba.linearise(free, state.of_points(long), True, np.float64))
    poses, lens = slice(0, -ba.LENS), slice(-ba.LENS, None)
    right = np.column_stack([system[poses, lens], gradient[poses]])
    eliminated = system[lens, poses] @ np.linalg.solve(system[poses, poses], right)
    return system[lens, lens] - eliminated[:, :-1], eliminated[:, -1] - gradient[lens]
