# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where to look for the points of the last image: their motion is guessed before it is measured.

A patch is found again only where the search starts near it, and in a repeated texture its twin
is found instead. Most frames move nearly as the one before did; by how much the image moved as a
whole tells what changed since, as when a camera begins to turn. Those points that are found lead
to the others.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from kfvo_ros.tracking import klt, motion_field
from kfvo_ros.tracking.klt import Matches
from kfvo_ros.tracking.motion_field import MotionField

ENOUGH = 0.4
"""When a smaller share of the points is found the guess was wrong: noise finds every fourth."""
MOST = 0.7
"""When a smaller share is found the guess may be that of a twin, and the next one is tried too; of
the better one, those found tell where the others are."""
SHRINKING = 4
"""The whole image is compared in this fraction of its size, where details do not matter ..."""
LEAST_SHIFT = 4.0
"""... and to no better than this [px]."""
INNER = np.array([[0.3, 0.3], [0.7, 0.3], [0.3, 0.7], [0.7, 0.7]])
"""Places in an image, in shares of its size, that stand for what its comparison weighs most."""


class TrackSearch:
    """Finds the points of one camera's last image in the next; `field` is how that one moved.

    Near and far move differently, and the image as a whole moves as neither: by how much its
    shift was off the last time it will be again.
    """

    def __init__(self, field: MotionField | None = None) -> None:
        self._field = field
        self._shift = np.zeros(2)
        self._bias = np.zeros(2)

    def find_again(self, last: np.ndarray, image: np.ndarray, points: np.ndarray) -> Matches:
        """Find points (N, 2) of `last` in `image`, which are (H, W) uint8 of one size."""
        best = Matches(points.copy(), np.zeros(len(points), dtype=bool), np.zeros(points.shape))
        for start in self._guesses(last, image, points):
            best = _better(best, klt.follow(last, image, points, start))
            if best.found.mean() >= MOST:
                return best
        if best.found.mean() < ENOUGH:
            best = _better(best, klt.follow(last, image, points))
        if ENOUGH <= best.found.mean() < MOST:
            _find_rest(last, image, points, best)
        return best

    def learn(self, before: np.ndarray, after: np.ndarray, size: np.ndarray) -> None:
        """Take in how tracks (N, 2) moved in the images searched last, of this size (2,) [px]."""
        field, self._field = self._field, motion_field.fit(before, after - before, size)
        self._bias = np.zeros(2)
        if field is not None and self._field is not None:
            change = self._field.at(INNER * size) - field.at(INNER * size)
            self._bias = self._shift - change.mean(axis=0)

    def _guesses(self, last: np.ndarray, image: np.ndarray,
                 points: np.ndarray) -> Iterator[np.ndarray]:
        """Generate where to start, likeliest first.

        The whole image tells better than the last motion what changed, as a rule; but the shift of
        a facade may be that of its windows, or what is near may have moved alone.
        """
        self._shift = whole_shift(last, image, self._field)
        if self._field is None:
            yield points + self._shift
        else:
            expected, shift = points + self._field.at(points), self._shift - self._bias
            if np.linalg.norm(shift) > LEAST_SHIFT:
                yield expected + shift
            yield expected


def whole_shift(last: np.ndarray, image: np.ndarray, field: MotionField | None) -> np.ndarray:
    """Return by how much (2,) [px] the whole image moved, or by how much more than a `field`.

    It is the peak of the phase correlation.
    """
    # Of whole blocks of pixels: others take OpenCV many times as long.
    size = np.maximum(np.array(image.shape[::-1]) // SHRINKING, 2)
    width, height = SHRINKING * size
    before, after = (cv2.resize(each[:height, :width], size, interpolation=cv2.INTER_AREA)
                     .astype(np.float32) for each in (last, image))
    if field is not None:
        places = INNER * field.size
        H = cv2.getPerspectiveTransform(*((each / SHRINKING).astype(np.float32)
                                          for each in (places, places + field.at(places))))
        before = cv2.warpPerspective(before, H, size, borderMode=cv2.BORDER_REPLICATE)
    shift, _ = cv2.phaseCorrelate(before, after, cv2.createHanningWindow(size, cv2.CV_32F))
    return SHRINKING * np.array(shift)


def _better(a: Matches, b: Matches) -> Matches:
    """Return those of which more were found."""
    return b if b.found.sum() > a.found.sum() else a


def _find_rest(last: np.ndarray, image: np.ndarray, points: np.ndarray,
               matches: Matches) -> None:
    """Look for the points not found where the others' motion leads; fill `matches`."""
    size, found = np.array(image.shape[::-1]), matches.found
    field = motion_field.fit(points[found], (matches.places - points)[found], size)
    if field is None:
        return
    start = points + field.at(points)
    rest = np.flatnonzero(~found & ((start >= 0) & (start < size)).all(axis=1))
    for of_all, of_rest in zip(matches, klt.follow(last, image, points[rest],
                                                   start[rest]), strict=True):
        of_all[rest] = of_rest
