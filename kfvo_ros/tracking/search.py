# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predicts the motion of tracked points before they are measured.

Lucas-Kanade converges only from a start near the solution, and to the wrong instance of a
repeated texture. Two predictions are tried: the last motion field corrected by the shift of the
whole image since then, which covers a camera that starts to turn, and the last motion field
alone. Points that are found predict the remaining ones.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from kfvo_ros.tracking import klt, motion_field
from kfvo_ros.tracking.klt import Matches
from kfvo_ros.tracking.motion_field import MotionField

WRONG_BELOW = 0.4
"""Share of points found below which the prediction is wrong: noise finds every fourth."""
CERTAIN_FROM = 0.7
"""Share of points found from which no other prediction is tried: below it the prediction may lead
to another instance of a repeated texture."""
SHRINK_FACTOR = 4
"""The whole image is compared at this fraction of its size, as details do not matter."""
MIN_SHIFT = 4.0
"""A whole-image shift below this is within its error [px]."""
INNER_POINTS = np.array([[0.3, 0.3], [0.7, 0.3], [0.3, 0.7], [0.7, 0.7]])
"""Points of an image, as shares of its size, that represent the area weighted by the window of
the phase correlation."""


class TrackSearch:
    """Tracks points of one camera from image to image, starting from predictions.

    `field` is the motion field of the last image. The phase correlation is biased, as near and
    far surfaces move differently: its error at the last image corrects the next shift.
    """

    def __init__(self, field: MotionField | None = None) -> None:
        self._field = field
        self._shift = np.zeros(2)
        self._bias = np.zeros(2)

    def match(self, last: np.ndarray, image: np.ndarray, points: np.ndarray) -> Matches:
        """Track points (N, 2) of `last` into `image`, both (H, W) uint8 of one size."""
        best = Matches(points.copy(), np.zeros(len(points), dtype=bool), np.zeros(points.shape))
        for start in self._predictions(last, image, points):
            best = _more_found(best, klt.track_points(last, image, points, start))
            if best.found.mean() >= CERTAIN_FROM:
                return best
        if best.found.mean() < WRONG_BELOW:
            best = _more_found(best, klt.track_points(last, image, points))
        if WRONG_BELOW <= best.found.mean() < CERTAIN_FROM:
            _track_remaining(last, image, points, best)
        return best

    def update(self, before: np.ndarray, after: np.ndarray, size: np.ndarray) -> None:
        """Update the motion field from verified tracks (N, 2) in images of size (2,) [px]."""
        field, self._field = self._field, motion_field.fit(before, after - before, size)
        self._bias = np.zeros(2)
        if field is not None and self._field is not None:
            inner = INNER_POINTS * size
            change = self._field.at(inner) - field.at(inner)
            self._bias = self._shift - change.mean(axis=0)

    def _predictions(self, last: np.ndarray, image: np.ndarray,
                     points: np.ndarray) -> Iterator[np.ndarray]:
        """Yield predicted points (N, 2), most likely first.

        The shift of the whole image usually improves the last motion field, but not where a facade
        repeats or where near objects alone moved.
        """
        self._shift = whole_image_shift(last, image, self._field)
        if self._field is None:
            yield points + self._shift
        else:
            expected, shift = points + self._field.at(points), self._shift - self._bias
            if np.linalg.norm(shift) > MIN_SHIFT:
                yield expected + shift
            yield expected


def whole_image_shift(last: np.ndarray, image: np.ndarray,
                      field: MotionField | None) -> np.ndarray:
    """Return the shift (2,) [px] of the whole image by phase correlation, beyond a `field`."""
    # Crop to whole blocks of pixels: OpenCV resizes other sizes many times slower.
    size = np.maximum(np.array(image.shape[::-1]) // SHRINK_FACTOR, 2)
    width, height = SHRINK_FACTOR * size
    before, after = (cv2.resize(each[:height, :width], size, interpolation=cv2.INTER_AREA)
                     .astype(np.float32) for each in (last, image))
    if field is not None:
        inner = INNER_POINTS * field.size
        H = cv2.getPerspectiveTransform(*((each / SHRINK_FACTOR).astype(np.float32)
                                          for each in (inner, inner + field.at(inner))))
        before = cv2.warpPerspective(before, H, size, borderMode=cv2.BORDER_REPLICATE)
    shift, _ = cv2.phaseCorrelate(before, after, cv2.createHanningWindow(size, cv2.CV_32F))
    return SHRINK_FACTOR * np.array(shift)


def _more_found(a: Matches, b: Matches) -> Matches:
    """Return `b` if more of its points were found, else `a`."""
    return b if b.found.sum() > a.found.sum() else a


def _track_remaining(last: np.ndarray, image: np.ndarray, points: np.ndarray,
                     matches: Matches) -> None:
    """Track points not found from the motion field of the others; writes into `matches`."""
    size, found = np.array(image.shape[::-1]), matches.found
    field = motion_field.fit(points[found], (matches.points - points)[found], size)
    if field is None:
        return
    start = points + field.at(points)
    rest = np.flatnonzero(~found & ((start >= 0) & (start < size)).all(axis=1))
    tracked = klt.track_points(last, image, points[rest], start[rest])
    for array, new in zip(matches, tracked, strict=True):
        array[rest] = new
