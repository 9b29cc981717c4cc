# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find the points of one image in the next: pyramidal Lucas-Kanade, searched, checked, refined.

A wide patch is what finds a point again, but it averages over surfaces that move differently. A
narrow one, started where the wide one ended, follows the point itself, or more nearly so.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

STEPS_OR_STEP = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
SEARCH = {'winSize': (21, 21), 'criteria': (STEPS_OR_STEP, 10, 0.03)}
REFINEMENT = {'winSize': (11, 11), 'criteria': (STEPS_OR_STEP, 30, 0.01), 'maxLevel': 0}
NEAR_LEVELS, FAR_LEVELS, BACKWARD_LEVELS = 2, 4, 1
"""Halvings of the image for a search from a prediction, from nothing, and back."""
MAX_ROUND_TRIP = 0.7
"""A point is lost when following it back misses its origin by more [px]."""
MAX_REFINEMENT = 2.0
"""... or when the narrow patch disagrees with the wide one by more [px]."""


class Matches(NamedTuple):
    """Points found again at ``places`` (N, 2) under the mask ``found`` (N,).

    ``parted`` (N, 2) is the way from where their wide patches ended to their narrow ones [px].
    """

    places: np.ndarray
    found: np.ndarray
    parted: np.ndarray


def follow(last: np.ndarray, image: np.ndarray, points: np.ndarray,
           predicted: np.ndarray | None = None) -> Matches:
    """Find points (N, 2) of `last` in `image`.

    Images are (H, W) uint8 of one size; `predicted` (N, 2) is where the search starts, else the
    points themselves are and it reaches farther.
    """
    start = points.astype(np.float32)
    levels = FAR_LEVELS if predicted is None else NEAR_LEVELS
    guess = start if predicted is None else predicted.astype(np.float32)
    end, found = _match(last, image, start, guess, SEARCH | {'maxLevel': levels})
    found &= _returns(last, image, start, end, SEARCH | {'maxLevel': BACKWARD_LEVELS})
    rows = np.flatnonzero(found)
    start, wide = start[rows], end[rows]
    narrow, refined = _match(last, image, start, wide, REFINEMENT)
    parted = np.zeros(end.shape)
    parted[rows] = narrow - wide
    refined &= np.linalg.norm(parted[rows], axis=1) < MAX_REFINEMENT
    refined &= _returns(last, image, start, narrow, REFINEMENT)
    end[rows], found[rows] = narrow, refined
    return Matches(end.astype(np.float64), found, parted)


def _returns(last: np.ndarray, image: np.ndarray, start: np.ndarray, end: np.ndarray,
             options: dict) -> np.ndarray:
    """Return a mask (N,) of the points that come back to `start` when followed from `end`."""
    back, found = _match(image, last, end, start, options)
    return found & (np.linalg.norm(back - start, axis=1) < MAX_ROUND_TRIP)


def _match(a: np.ndarray, b: np.ndarray, points: np.ndarray, guess: np.ndarray,
           options: dict) -> tuple[np.ndarray, np.ndarray]:
    if len(points) == 0:
        return points.copy(), np.zeros(0, dtype=bool)
    end, found, _ = cv2.calcOpticalFlowPyrLK(a, b, points, guess.copy(),
                                             flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options)
    return end, found[:, 0] > 0
