# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Smooth motion field of an image: a polynomial fitted to tracks, evaluated at any pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MIN_TRACKS = 24
"""Fewer tracks determine no field."""
KEPT_SHARE = 0.8
"""Share of the tracks, those with the smallest residuals, that the second fit uses."""


@dataclass(frozen=True)
class MotionField:
    """Second-order polynomials in x and y, which hold the flow of a small rotation exactly.

    ``coefficients`` (6, 2) in the unit of the fitted motion; ``size`` (2,) is the image's width
    and height [px].
    """

    coefficients: np.ndarray
    size: np.ndarray

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """Return the motion (N, 2) of pixels (N, 2)."""
        return _monomials(pixels, self.size) @ self.coefficients


def fit(pixels: np.ndarray, motion: np.ndarray, size: np.ndarray) -> MotionField | None:
    """Fit a field to the `motion` (N, 2) of `pixels` (N, 2); None with too few of them."""
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
