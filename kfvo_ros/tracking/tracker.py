# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What two frames have in common, by their increasing track ids."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.tracking.corners import find_corners
from kfvo_ros.tracking.klt import Matches
from kfvo_ros.tracking.search import TrackSearch

FEATURES = 400
CLAHE_CLIP, CLAHE_TILES = 3.0, (8, 8)
RIM = 4
"""Patches are followed no closer to the rim [px]."""
MAX_EPIPOLAR_ERROR = 1.5
RANSAC_CONFIDENCE, RANSAC_ITERATIONS = 0.99, 300
MIN_RANSAC_TRACKS = 16
MIN_INLIER_SHARE = 0.4
"""Below it the consensus is chance, and nothing is dropped for disagreeing with it."""
SLIDING = 0.2
"""The narrow patch slides by this share of what it and the wide one part by."""
MIN_SURVIVORS = 12
"""With fewer, the frame is taken for a flash, a shutter or a cut."""
MAX_BLINKS = 3
"""After so many such frames in a row the scene is taken for a new one."""


def shared(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the same ids stand in `a` and in `b`, both increasing: indices (M,) each."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    places = b.searchsorted(a)
    in_a = np.flatnonzero(b.take(places, mode='clip') == a)
    return in_a, places[in_a]


def present(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of the ids in `a` that are in `b` too, both increasing."""
    mask = np.zeros(len(a), dtype=bool)
    mask[shared(a, b)[0]] = True
    return mask


@dataclass(frozen=True)
class Tracks:
    """What is seen in one frame: ``ids`` (N,) int64, increasing, at ``pixels`` (N, 2).

    ``doubts`` (N,) are by how much their patches part from frame to frame [px].
    """

    ids: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    pixels: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    doubts: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, mask: np.ndarray) -> Tracks:
        """Return the tracks under a boolean mask (N,)."""
        return Tracks(self.ids[mask], self.pixels[mask], self.doubts[mask])


@dataclass(frozen=True)
class _Trails:
    """Corners followed for ``frames`` (N,), in which their patches came to ``places`` (N, 2).

    ``parted`` (N, 2) is the sum of the ways from wide patches to narrow ones [px].
    """

    ids: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    places: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    parted: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    frames: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.ids)

    def followed(self, matches: Matches) -> _Trails:
        """Return those of the trails that were found again, one frame on."""
        found = matches.found
        return _Trails(self.ids[found], matches.places[found],
                       self.parted[found] + matches.parted[found], self.frames[found] + 1)

    def joined(self, first_id: int, corners: np.ndarray) -> _Trails:
        """Return the trails and new ones that begin at corners (M, 2)."""
        count = len(corners)
        return _Trails(np.concatenate([self.ids, first_id + np.arange(count)]),
                       np.concatenate([self.places, corners]),
                       np.concatenate([self.parted, np.zeros((count, 2))]),
                       np.concatenate([self.frames, np.zeros(count, dtype=np.int64)]))

    def tracks(self) -> Tracks:
        """Return where the points are that the patches were set on, as far as can be told."""
        doubts = np.linalg.norm(self.parted, axis=1) / np.maximum(self.frames, 1)
        return Tracks(self.ids, self.places + SLIDING * self.parted, doubts)


def common(a: Tracks, b: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (M, 2) in a and in b of the tracks that both see."""
    in_a, in_b = shared(a.ids, b.ids)
    return a.pixels.take(in_a, axis=0), b.pixels.take(in_b, axis=0)


def mean_flow(before: np.ndarray, after: np.ndarray) -> float:
    """Return the mean length of the motion from pixels (M, 2) to pixels, 0 of none [px]."""
    # Of a few numbers NumPy's mean takes longer than the sum that it is.
    return float(np.hypot(*(after - before).T).sum() / len(before)) if len(before) else 0.0


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
        self._trails = _Trails()
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
        gone = len(survivors) < MIN_SURVIVORS <= len(self._trails)
        if gone and self._blinks < MAX_BLINKS:
            self._blinks += 1
            return Tracks()
        self._blinks = 0
        self._image = image
        self._trails = self._refill(image, survivors)
        return self._trails.tracks()

    def _follow(self, last: np.ndarray | None, image: np.ndarray) -> _Trails:
        """Track the last image's corners into `image` and drop those that do not agree."""
        if last is None or len(self._trails) == 0 or image.shape != last.shape:
            self._search = TrackSearch()
            return _Trails()
        size = np.array(image.shape[::-1])
        before = self._trails.places
        matches = self._search.find_again(last, image, before)
        after = matches.places
        found = matches.found & ((after >= RIM) & (after < size - RIM)).all(axis=1)
        found[found] = self._agreeing(before[found], after[found])
        self._search.learn(before[found], after[found], size)
        return self._trails.followed(matches._replace(found=found))

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

    def _refill(self, image: np.ndarray, survivors: _Trails) -> _Trails:
        """Add corners where there are no tracks, up to the wanted number."""
        missing = self._features - len(survivors)
        if missing < 0.1 * self._features:
            return survivors
        corners = find_corners(image, survivors.places, missing)
        trails = survivors.joined(self._next_id, corners)
        self._next_id += len(corners)
        return trails


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
