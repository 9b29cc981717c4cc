# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the whole image moves between two frames: smooth enough to be known between the tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MIN_TRACKS = 24
"""With fewer tracks there is no field."""
KEPT_SHARE = 0.8
"""The field is fitted once more without the tracks that agree least."""


@dataclass(frozen=True)
class MotionField:
    """Polynomials of second order in the image: the flow of a rotation is one of them.

    ``coefficients`` (6, 2) give motion in the unit of what was fitted, ``size`` (2,) is the
    image's width and height [px].
    """

    coefficients: np.ndarray
    size: np.ndarray

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """Return the motion (N, 2) of pixels (N, 2)."""
        return _monomials(pixels, self.size) @ self.coefficients


def fit(pixels: np.ndarray, motion: np.ndarray, size: np.ndarray) -> MotionField | None:
    """Return the field nearest to the `motion` (N, 2) of `pixels` (N, 2), None for too few."""
    if len(pixels) < MIN_TRACKS:
        return None
    monomials = _monomials(pixels, size)
    coefficients = np.linalg.lstsq(monomials, motion, rcond=None)[0]
    errors = np.linalg.norm(motion - monomials @ coefficients, axis=1)
    kept = errors <= np.quantile(errors, KEPT_SHARE)
    coefficients = np.linalg.lstsq(monomials[kept], motion[kept], rcond=None)[0]
    return MotionField(coefficients, size)


def _monomials(pixels: np.ndarray, size: np.ndarray) -> np.ndarray:
    x, y = ((pixels - 0.5 * size) / size[0]).T
    return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
