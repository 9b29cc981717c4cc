# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detection of blind images: black, saturated, a covered lens, or nothing but sensor noise.

The tracker raises the contrast of images, and would find corners in amplified noise. The contrast
of a group of 2 x 2 cells a b / c d is a - b - c + d; edges along an axis, vignetting and noise of
whole rows have none. From cells to cells of twice the side, the mean square contrast of
independent noise falls to a quarter: 0.20 to 0.31 as measured, up to 0.34 where demosaicking or
JPEG correlates the noise. That of rendered and recorded images changes by a factor of 0.6 to 2.4,
and of at least 0.38 in most where noise nearly drowns corners that are still tracked.
"""

from __future__ import annotations

import cv2
import numpy as np

MAX_CELLS = 2400
"""Largest number of cells of an image, for a reliable mean: their side is a power of two."""
MIN_CONTRAST = 0.18
"""Least mean square contrast of cells [grey values^2]. The rounding of smooth shading causes up to
0.16; images at a thirtieth of a usual exposure have 0.1 to 0.6."""
NOISE_RATIO = 0.32
"""Largest ratio of the mean square contrasts of cells and half cells in noise."""
MAX_CONTRAST = 4.0
"""Largest mean square contrast of cells in correlated sensor noise [grey values^2]. Above it, a
fine texture averages out alike, but its pixels are correlated."""
MAX_CORRELATION = 2.0
"""Largest ratio of the mean square contrast of half cells to that expected from pixels that are
independent; it is 1 for white noise but for rounding."""
ROW_STEP = 8
"""The contrast of pixels is measured in every eighth row."""


def is_flat(grey: np.ndarray) -> bool:
    """Return whether an image (H, W) uint8 shows nothing but smooth shading."""
    return _cell_contrasts(grey)[0] < MIN_CONTRAST


def is_blind(grey: np.ndarray) -> bool:
    """Return whether an image (H, W) uint8 shows nothing but smooth shading and noise."""
    coarse, fine, pixels = _cell_contrasts(grey)
    if coarse < MIN_CONTRAST:
        return True
    return coarse <= NOISE_RATIO * fine and (
        coarse < MAX_CONTRAST or pixels * fine < MAX_CORRELATION * _pixel_contrast(grey))


def _cell_contrasts(grey: np.ndarray) -> tuple[float, float, int]:
    """Return the mean square contrasts of cells and half cells, and the pixels of a half cell.

    An image of fewer than 2 x 2 cells cannot be judged: its contrast is infinite.
    """
    side = 1
    while grey.size > MAX_CELLS * side ** 2:
        side *= 2
    if min(grey.shape) < 2 * side:
        return np.inf, 0.0, 1
    half_cells = grey[:grey.shape[0] // side * side, :grey.shape[1] // side * side]
    for _ in range(side.bit_length() - 2):
        half_cells = _halve(half_cells)
    half_cells = half_cells.astype(np.float32)
    fine = _mean_square_contrast(half_cells)
    coarse = fine if side == 1 else _mean_square_contrast(_halve(half_cells))
    return coarse, fine, max(side // 2, 1) ** 2


def _halve(image: np.ndarray) -> np.ndarray:
    """Return the means of blocks of 2 x 2 pixels."""
    height, width = image.shape
    return cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)


def _mean_square_contrast(cells: np.ndarray) -> float:
    """Return the mean square of a - b - c + d over all groups of 2 x 2 cells of (H, W) float32."""
    down = cells[1:] - cells[:-1]
    contrast = (down[:, 1:] - down[:, :-1]).ravel()
    return float(contrast @ contrast) / contrast.size


def _pixel_contrast(grey: np.ndarray) -> float:
    """Return the mean square contrast of 2 x 2 pixels in every ROW_STEP-th row."""
    upper, lower = grey[:-1:ROW_STEP].astype(np.float32), grey[1::ROW_STEP].astype(np.float32)
    down = lower - upper
    return float(np.square(down[:, 1:] - down[:, :-1]).mean())
