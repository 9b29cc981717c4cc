# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a bundle adjustment knows, seeks and solves; named tuples, which compiled code can take."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


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
