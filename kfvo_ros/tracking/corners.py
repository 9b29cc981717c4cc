# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Corners worth following, spread over the image.

Those of a large image are found in its half, which costs a quarter and knows corners from noise,
and put where the gradients around them meet in the whole.
"""

from __future__ import annotations

import cv2
import numpy as np

LARGE = 200_000
"""An image of more pixels is searched at half its size."""
CELL = 32
"""New corners are spread over cells of this size [px of the image searched]."""
MIN_DISTANCE = 6
"""Corners keep this far apart [px of the image searched]."""
BORDER = 8
"""No corner lies this close to the rim [px]."""
HARRIS = 0.04
"""Points whose gradients point one way, along an edge, are no corners: a track would slide."""
MIN_RESPONSE, TINY_RESPONSE = 3e-4, 1e-6
"""A corner's response must reach this share of the image's strongest, which is none if tiny."""
MAX_SHIFT = 5
"""The precise corner is looked for this far away [px]."""
PRECISION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.05)


def find_corners(image: np.ndarray, occupied: np.ndarray, count: int) -> np.ndarray:
    """Return up to `count` corners (N, 2) [px] of an image (H, W) away from `occupied` (M, 2)."""
    size = np.array(image.shape[::-1])
    factor = 2 if image.size > LARGE and size.min() > 1 else 1
    small = cv2.resize(image, tuple(int(side) for side in size // factor),
                       interpolation=cv2.INTER_AREA)
    # A pixel of the small image is centred between those that it covers.
    offset = 0.5 * (factor - 1)
    occupied = (occupied - offset) / factor
    corners = factor * _peaks(small, occupied, count, BORDER // factor) + offset
    if len(corners) == 0:
        return corners
    precise = cv2.cornerSubPix(image, np.ascontiguousarray(corners[:, None], dtype=np.float32),
                               (MAX_SHIFT, MAX_SHIFT), (-1, -1), PRECISION)[:, 0]
    moved = np.abs(precise - corners).max(axis=1) <= MAX_SHIFT
    moved &= ((precise >= BORDER) & (precise < size - BORDER)).all(axis=1)
    return _apart(np.where(moved[:, None], precise, corners).astype(np.float64))


def _apart(corners: np.ndarray) -> np.ndarray:
    """Drop corners (N, 2) that have come close to an earlier one."""
    close = np.linalg.norm(corners[:, None] - corners, axis=2) < MIN_DISTANCE
    return corners[~np.tril(close, -1).any(axis=1)]


def _peaks(image: np.ndarray, occupied: np.ndarray, count: int, border: int) -> np.ndarray:
    """Return the peaks (N, 2) of Harris's response to a small image."""
    response = cv2.cornerHarris(image, 3, 3, HARRIS)
    response[:border] = response[-border:] = 0.0
    response[:, :border] = response[:, -border:] = 0.0
    for x, y in occupied.round().astype(int):
        cv2.circle(response, (int(x), int(y)), MIN_DISTANCE, 0.0, -1)
    reach = np.ones((MIN_DISTANCE + 1, MIN_DISTANCE + 1), dtype=np.uint8)
    peaks = (response == cv2.dilate(response, reach)) & (
        response > MIN_RESPONSE * max(float(response.max()), TINY_RESPONSE))
    y, x = np.nonzero(peaks)
    chosen = _spread(x, y, response[y, x], image.shape[1])[:count]
    return np.column_stack([x[chosen], y[chosen]]).astype(np.float64)


def _spread(x: np.ndarray, y: np.ndarray, strength: np.ndarray, width: int) -> np.ndarray:
    """Order corners: the best of every cell first, then the second best of every cell, ..."""
    cell = (y // CELL) * (width // CELL + 1) + x // CELL
    order = np.lexsort((-strength, cell))
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    return np.lexsort((-strength, rank))
