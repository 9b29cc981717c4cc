# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a bundle adjustment knows, seeks and solves; named tuples, which compiled code can take."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Problem(NamedTuple):
    """What is measured in a window of F frames and P points.

    ``hosts`` (P,), ``rays`` (P, 3), ``seen`` (P, F, 2) under ``mask`` (P, F), normalised and
    undistorted; ``focal`` [px]. The first ``fixed`` frames are not moved. A point's inverse
    depth r is drawn to ``prior_values`` (P,) with ``prior_weights`` (P,) [px^2 per unit squared].
    """

    hosts: np.ndarray
    rays: np.ndarray
    seen: np.ndarray
    mask: np.ndarray
    focal: float
    fixed: int
    prior_weights: np.ndarray
    prior_values: np.ndarray


class State(NamedTuple):
    """Where frames and points are: rotations (F, 3, 3), translations (F, 3), depths (P,)."""

    rotations: np.ndarray
    translations: np.ndarray
    inverse_depths: np.ndarray

    def scaled(self, factor: float) -> State:
        """Return the same window in another unit."""
        return State(self.rotations, self.translations * factor, self.inverse_depths / factor)


class NormalEquations(NamedTuple):
    """Gauss-Newton Hessian and gradient of half the cost, depths apart from poses.

    With C = 6 (F - fixed), ``H_cc`` (C, C) and ``g_c`` (C,) belong to the poses (rotation, then
    translation, of each free frame), ``H_pp`` (P,) and ``g_p`` (P,) to the inverse depths,
    ``H_cp`` (C, P) couples them.
    """

    H_cc: np.ndarray
    g_c: np.ndarray
    H_cp: np.ndarray
    H_pp: np.ndarray
    g_p: np.ndarray
