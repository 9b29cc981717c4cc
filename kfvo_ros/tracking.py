# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The one KLT tracker: corners followed from input frame to input frame.

Tracks never depend on keyframe decisions, so a sequence can be tracked once and any policy run
on the result.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.corners import find_corners
from kfvo_ros.track_ids import shared
from kfvo_ros.track_search import TrackSearch

FEATURES = 400
CLAHE_CLIP, CLAHE_TILES = 3.0, (8, 8)
RIM = 4
"""Tracks end this close to the rim [px]."""

MAX_EPIPOLAR_ERROR = 1.5
RANSAC_CONFIDENCE, RANSAC_ITERATIONS = 0.99, 300
MIN_RANSAC_TRACKS = 16
MIN_INLIER_SHARE = 0.4
"""Below it the consensus is chance, and nothing is dropped for disagreeing with it."""

MIN_SURVIVORS = 12
"""With fewer, the frame is taken for a flash, a shutter or a cut."""
MAX_BLINKS = 3
"""After so many such frames in a row the scene is taken for a new one."""


@dataclass(frozen=True)
class Tracks:
    """What is seen in one frame: ``ids`` (N,) int64, increasing, at ``pixels`` (N, 2)."""

    ids: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    pixels: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, mask: np.ndarray) -> Tracks:
        """Return the tracks under a boolean mask or at sorted indices."""
        return Tracks(self.ids[mask], self.pixels[mask])


def common(a: Tracks, b: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (M, 2) in a and in b of the tracks that both see."""
    in_a, in_b = shared(a.ids, b.ids)
    return a.pixels[in_a], b.pixels[in_b]


def mean_flow(before: np.ndarray, after: np.ndarray) -> float:
    """Return the mean length of the motion from pixels (M, 2) to pixels, 0 of none [px]."""
    return float(np.hypot(*(after - before).T).mean()) if len(before) else 0.0


class Tracker:
    """Follow corners through the frames of one sequence.

    `camera` lets the outlier test see straight epipolar lines through a distorting lens.
    """

    def __init__(self, camera: Camera | None = None, features: int = FEATURES,
                 seed: int = 0) -> None:
        self._camera = camera if camera and camera.distortion_model != 'none' else None
        self._features = features
        self._ransac = _ransac(seed)
        self._equaliser = cv2.createCLAHE(CLAHE_CLIP, CLAHE_TILES)
        self._image: np.ndarray | None = None
        self._tracks = Tracks()
        self._search = TrackSearch()
        self._next_id = 0
        self._blinks = 0

    def track(self, grey: np.ndarray) -> Tracks:
        """Return the tracks of the next frame (H, W) uint8: survivors first, then new corners.

        A frame in which nearly nothing is found again (black, a flash) has no tracks, and the
        next ones are tracked from the frame before it, until the scene is taken for a new one.
        """
        image = self._equaliser.apply(grey)
        survivors = self._follow(self._image, image)
        gone = len(survivors) < MIN_SURVIVORS <= len(self._tracks)
        if gone and self._blinks < MAX_BLINKS:
            self._blinks += 1
            return Tracks()
        self._blinks = 0
        self._image = image
        self._tracks = self._refill(image, survivors)
        return self._tracks

    def _follow(self, last: np.ndarray | None, image: np.ndarray) -> Tracks:
        """Track the last image's corners into `image` and drop those that do not agree."""
        if last is None or len(self._tracks) == 0 or image.shape != last.shape:
            self._search = TrackSearch()
            return Tracks()
        size = np.array(image.shape[::-1])
        before = self._tracks.pixels
        after, found = self._search.find_again(last, image, before)
        found &= ((after >= RIM) & (after < size - RIM)).all(axis=1)
        found[found] = self._agreeing(before[found], after[found])
        self._search.learn(before[found], after[found], size)
        return Tracks(self._tracks.ids[found], after[found])

    def _agreeing(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of the pairs that follow one epipolar geometry."""
        everyone = np.ones(len(before), dtype=bool)
        if len(before) < MIN_RANSAC_TRACKS:
            return everyone
        if self._camera is not None:
            focal = 0.5 * (self._camera.fx + self._camera.fy)
            before, after = (focal * self._camera.undistort(p) for p in (before, after))
            everyone &= np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
        try:
            _, inliers = cv2.findFundamentalMat(before[everyone], after[everyone], self._ransac)
        except cv2.error:  # OpenCV gives up on some sets that have no unique geometry.
            return everyone
        if inliers is not None and inliers.mean() > MIN_INLIER_SHARE:
            everyone[everyone] = inliers[:, 0] > 0
        return everyone

    def _refill(self, image: np.ndarray, survivors: Tracks) -> Tracks:
        """Add corners where there are no tracks, up to the wanted number."""
        missing = self._features - len(survivors)
        if missing < 0.1 * self._features:
            return survivors
        corners = find_corners(image, survivors.pixels, missing)
        ids = np.arange(self._next_id, self._next_id + len(corners))
        self._next_id += len(corners)
        return Tracks(np.concatenate([survivors.ids, ids]),
                      np.concatenate([survivors.pixels, corners]))


def _ransac(seed: int) -> cv2.UsacParams:
    """Return the parameters of MAGSAC."""
    params = cv2.UsacParams()
    params.randomGeneratorState = seed % (1 << 31)  # OpenCV's is a C int.
    params.threshold = MAX_EPIPOLAR_ERROR
    params.confidence = RANSAC_CONFIDENCE
    params.maxIterations = RANSAC_ITERATIONS
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    params.loIterations = 5
    return params
