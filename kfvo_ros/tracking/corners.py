# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Corner detection: Harris corners at sub-pixel precision, spread over the image.

Corners of a large image are detected at half its size, which takes a quarter of the time and
suppresses noise, and refined at full size.
"""

from __future__ import annotations

import cv2
import numpy as np

MAX_FULL_SIZE = 200_000
"""Images of more pixels are searched at half their size."""
CELL = 32
"""Size of the cells over which corners are spread [px of the searched image]."""
MIN_DISTANCE = 6
"""Least distance between corners [px of the searched image]."""
BORDER = 8
"""Least distance of a corner from the image border [px]."""
HARRIS_K = 0.04
"""Harris's parameter; it rejects edges, along which a track would slide."""
MIN_RELATIVE_RESPONSE, MIN_PEAK_RESPONSE = 3e-4, 1e-6
"""Least response relative to the image's strongest, which counts as at least the second number."""
MAX_SHIFT = 5
"""Largest sub-pixel correction [px]."""
REFINEMENT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.05)


def find_corners(image: np.ndarray, occupied: np.ndarray, count: int) -> np.ndarray:
    """Return up to `count` corners (N, 2) [px] of an image (H, W) away from `occupied` (M, 2)."""
    size = np.array(image.shape[::-1])
    factor = 2 if image.size > MAX_FULL_SIZE and size.min() > 1 else 1
    small = cv2.resize(image, tuple(int(side) for side in size // factor),
                       interpolation=cv2.INTER_AREA)
    # The centre of a small pixel lies between the centres of the pixels that it covers.
    offset = 0.5 * (factor - 1)
    occupied = (occupied - offset) / factor
    corners = factor * _harris_peaks(small, occupied, count, BORDER // factor) + offset
    if len(corners) == 0:
        return corners
    precise = cv2.cornerSubPix(image, np.ascontiguousarray(corners[:, None], dtype=np.float32),
                               (MAX_SHIFT, MAX_SHIFT), (-1, -1),
                               REFINEMENT_CRITERIA)[:, 0]
    refined = np.abs(precise - corners).max(axis=1) <= MAX_SHIFT
    refined &= ((precise >= BORDER) & (precise < size - BORDER)).all(axis=1)
    return _drop_close(np.where(refined[:, None], precise, corners).astype(np.float64))


def _drop_close(corners: np.ndarray) -> np.ndarray:
    """Drop corners (N, 2) that are closer than MIN_DISTANCE to an earlier one."""
    close = np.linalg.norm(corners[:, None] - corners, axis=2) < MIN_DISTANCE
    return corners[~np.tril(close, -1).any(axis=1)]


def _harris_peaks(image: np.ndarray, occupied: np.ndarray, count: int,
                  border: int) -> np.ndarray:
    """Return the pixels (N, 2) of at most `count` local maxima of the Harris response."""
    response = cv2.cornerHarris(image, 3, 3, HARRIS_K)
    response[:border] = response[-border:] = 0.0
    response[:, :border] = response[:, -border:] = 0.0
    for x, y in occupied.round().astype(int):
        cv2.circle(response, (int(x), int(y)), MIN_DISTANCE, 0.0, -1)
    neighbourhood = np.ones((MIN_DISTANCE + 1, MIN_DISTANCE + 1), dtype=np.uint8)
    threshold = MIN_RELATIVE_RESPONSE * max(float(response.max()), MIN_PEAK_RESPONSE)
    peaks = (response == cv2.dilate(response, neighbourhood)) & (response > threshold)
    y, x = np.nonzero(peaks)
    chosen = _order_by_cell(x, y, response[y, x], image.shape[1])[:count]
    return np.column_stack([x[chosen], y[chosen]]).astype(np.float64)


def _order_by_cell(x: np.ndarray, y: np.ndarray, strength: np.ndarray, width: int) -> np.ndarray:
    """Return indices (N,): the strongest corner of each cell first, then the second of each."""
    cell = (y // CELL) * (width // CELL + 1) + x // CELL
    order = np.lexsort((-strength, cell))
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    return np.lexsort((-strength, rank))
