# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pyramidal Lucas-Kanade in two stages, each with a forward-backward check.

A wide patch converges from afar but averages over surfaces that move differently. A narrow patch,
started at its result, follows the point itself more closely.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

COUNT_OR_EPS = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
SEARCH = {'winSize': (21, 21), 'criteria': (COUNT_OR_EPS, 10, 0.03)}
REFINEMENT = {'winSize': (11, 11), 'criteria': (COUNT_OR_EPS, 30, 0.01), 'maxLevel': 0}
PREDICTED_LEVELS, UNPREDICTED_LEVELS, BACKWARD_LEVELS = 2, 4, 1
"""Pyramid levels above the image: with a prediction, without one, and for the backward check."""
MAX_BACKWARD_ERROR = 0.7
"""Largest distance between a point and its forward-backward track [px]."""
MAX_REFINEMENT = 2.0
"""Largest distance between the results of the wide and the narrow patch [px]."""


class Matches(NamedTuple):
    """Tracked ``points`` (N, 2) [px], valid under the mask ``found`` (N,).

    ``patch_disagreement`` (N, 2) is the result of the narrow patch minus that of the wide one
    [px].
    """

    points: np.ndarray
    found: np.ndarray
    patch_disagreement: np.ndarray


def track_points(last: np.ndarray, image: np.ndarray, points: np.ndarray,
                 predicted: np.ndarray | None = None) -> Matches:
    """Track points (N, 2) of `last` into `image`, both (H, W) uint8 of one size.

    The search starts at `predicted` (N, 2); without it, at the points, with a deeper pyramid.
    """
    start = points.astype(np.float32)
    levels = UNPREDICTED_LEVELS if predicted is None else PREDICTED_LEVELS
    guess = start if predicted is None else predicted.astype(np.float32)
    end, found = _lucas_kanade(last, image, start, guess, SEARCH | {'maxLevel': levels})
    found &= _returns(last, image, start, end, SEARCH | {'maxLevel': BACKWARD_LEVELS})
    rows = np.flatnonzero(found)
    start, wide = start[rows], end[rows]
    narrow, refined = _lucas_kanade(last, image, start, wide, REFINEMENT)
    patch_disagreement = np.zeros(end.shape)
    patch_disagreement[rows] = narrow - wide
    refined &= np.linalg.norm(patch_disagreement[rows], axis=1) < MAX_REFINEMENT
    refined &= _returns(last, image, start, narrow, REFINEMENT)
    end[rows], found[rows] = narrow, refined
    return Matches(end.astype(np.float64), found, patch_disagreement)


def _returns(last: np.ndarray, image: np.ndarray, start: np.ndarray, end: np.ndarray,
             options: dict) -> np.ndarray:
    """Return the mask (N,) of the points that return to `start` when tracked back from `end`."""
    back, found = _lucas_kanade(image, last, end, start, options)
    return found & (np.linalg.norm(back - start, axis=1) < MAX_BACKWARD_ERROR)


def _lucas_kanade(a: np.ndarray, b: np.ndarray, points: np.ndarray, guess: np.ndarray,
                  options: dict) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (N, 2) of image `a` in image `b`, and the mask (N,) of the found ones."""
    if len(points) == 0:
        return points.copy(), np.zeros(0, dtype=bool)
    end, found, _ = cv2.calcOpticalFlowPyrLK(a, b, points, guess.copy(),
                                             flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options)
    return end, found[:, 0] > 0
