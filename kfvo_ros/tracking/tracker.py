# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""KLT tracker: corners with persistent ids through the frames of one sequence.

New tracks get increasing ids and each frame's ids are sorted, so frames are joined by sorted ids.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.tracking.blindness import is_blind
from kfvo_ros.tracking.corners import find_corners
from kfvo_ros.tracking.klt import Matches
from kfvo_ros.tracking.search import TrackSearch

FEATURES = 400
"""Number of tracks per frame."""
CLAHE_CLIP, CLAHE_TILES = 3.0, (8, 8)
BORDER = 4
"""Least distance of a track from the image border [px]."""
MAX_EPIPOLAR_ERROR = 1.5
"""Inlier threshold [px]."""
RANSAC_CONFIDENCE, RANSAC_ITERATIONS = 0.99, 300
MIN_RANSAC_TRACKS = 16
MIN_INLIER_SHARE = 0.4
"""Below this share the consensus is chance and no track is rejected."""
PATCH_BIAS = 0.2
"""Drift of the narrow patch, as a share of its disagreement with the wide patch."""
MIN_SURVIVORS = 12
"""With fewer surviving tracks the frame is skipped as a flash or a cut."""
MAX_SKIPPED = 3
"""After this number of skipped frames in a row tracking restarts."""


@dataclass(frozen=True)
class Tracks:
    """Tracks of one frame: ``ids`` (N,) int64, increasing, at ``pixels`` (N, 2).

    ``uncertainty`` (N,) is the mean disagreement of wide and narrow patch per frame [px].
    """

    ids: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    pixels: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    uncertainty: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, mask: np.ndarray) -> Tracks:
        """Return the tracks under a boolean mask (N,)."""
        return Tracks(self.ids[mask], self.pixels[mask], self.uncertainty[mask])


def match_ids(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (M,) in `a` and in `b` of their common ids, both increasing."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    positions = b.searchsorted(a)
    in_a = np.flatnonzero(b.take(positions, mode='clip') == a)
    return in_a, positions[in_a]


def ids_in(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of the ids in `a` that are in `b`, both increasing."""
    mask = np.zeros(len(a), dtype=bool)
    mask[match_ids(a, b)[0]] = True
    return mask


def common_pixels(a: Tracks, b: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (M, 2) in `a` and in `b` of their common tracks."""
    in_a, in_b = match_ids(a.ids, b.ids)
    return a.pixels.take(in_a, axis=0), b.pixels.take(in_b, axis=0)


def mean_flow(before: np.ndarray, after: np.ndarray) -> float:
    """Return the mean distance [px] between pixels (M, 2) and pixels (M, 2), 0 if M is 0."""
    # For few numbers np.mean takes longer than the sum itself.
    return float(np.hypot(*(after - before).T).sum() / len(before)) if len(before) else 0.0


@dataclass(frozen=True)
class _TrackState:
    """Tracks between two frames: narrow patches at ``points`` (N, 2), tracked for ``frames`` (N,).

    ``patch_disagreement`` (N, 2) [px] is the sum of that of `Matches` over these frames.
    """

    ids: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    patch_disagreement: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    frames: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.ids)

    def advance(self, matches: Matches) -> _TrackState:
        """Return the tracks that were found in the next frame."""
        found = matches.found
        disagreement = self.patch_disagreement[found] + matches.patch_disagreement[found]
        return _TrackState(self.ids[found], matches.points[found], disagreement,
                           self.frames[found] + 1)

    def extend(self, first_id: int, corners: np.ndarray) -> _TrackState:
        """Return these tracks and new ones at corners (M, 2), with ids from `first_id` on."""
        count = len(corners)
        return _TrackState(np.concatenate([self.ids, first_id + np.arange(count)]),
                       np.concatenate([self.points, corners]),
                       np.concatenate([self.patch_disagreement, np.zeros((count, 2))]),
                       np.concatenate([self.frames, np.zeros(count, dtype=np.int64)]))

    def tracks(self) -> Tracks:
        """Return the tracks with their pixels corrected for the drift of the narrow patches."""
        uncertainty = np.linalg.norm(self.patch_disagreement, axis=1) / np.maximum(self.frames, 1)
        return Tracks(self.ids, self.points + PATCH_BIAS * self.patch_disagreement, uncertainty)


class Tracker:
    """Tracks about `features` corners through the frames of one sequence.

    With a distorting `camera` outliers are rejected in undistorted coordinates. `seed` is that of
    RANSAC.
    """

    def __init__(self, camera: Camera | None = None, features: int = FEATURES,
                 seed: int = 0) -> None:
        self._camera = camera if camera and camera.distortion_model != 'none' else None
        self._features = features
        self._ransac = _magsac_parameters(seed)
        self._equaliser = cv2.createCLAHE(CLAHE_CLIP, CLAHE_TILES)
        self._image: np.ndarray | None = None
        self._state = _TrackState()
        self._search = TrackSearch()
        self._next_id = 0
        self._skipped = 0

    def track(self, grey: np.ndarray) -> Tracks:
        """Return the tracks of the next frame (H, W) uint8: surviving tracks, then new corners.

        A blind frame has no tracks, nor has one in which nearly all are lost (a flash, a cut). The
        next frame is tracked from the one before it. After MAX_SKIPPED such frames tracking
        restarts, in the next frame that is not blind.
        """
        if is_blind(grey):
            self._skipped += 1
            if self._skipped > MAX_SKIPPED:
                self._image = None
            return Tracks()
        image = self._equaliser.apply(grey)
        survivors = self._track_survivors(self._image, image)
        is_lost = len(survivors) < MIN_SURVIVORS <= len(self._state)
        if is_lost and self._skipped < MAX_SKIPPED:
            self._skipped += 1
            return Tracks()
        self._skipped = 0
        self._image = image
        self._state = self._refill(image, survivors)
        return self._state.tracks()

    def _track_survivors(self, last: np.ndarray | None, image: np.ndarray) -> _TrackState:
        """Track the last image's points into `image` and reject outliers."""
        if last is None or len(self._state) == 0 or image.shape != last.shape:
            self._search = TrackSearch()
            return _TrackState()
        size = np.array(image.shape[::-1])
        before = self._state.points
        matches = self._search.match(last, image, before)
        after = matches.points
        found = matches.found & ((after >= BORDER) & (after < size - BORDER)).all(axis=1)
        found[found] = self._inliers(before[found], after[found])
        self._search.update(before[found], after[found], size)
        return self._state.advance(matches._replace(found=found))

    def _inliers(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the mask (N,) of the pairs that are consistent with one epipolar geometry."""
        mask = np.ones(len(before), dtype=bool)
        if len(before) < MIN_RANSAC_TRACKS:
            return mask
        if self._camera is not None:
            focal = 0.5 * (self._camera.fx + self._camera.fy)
            before, after = (focal * self._camera.undistort(p) for p in (before, after))
            mask &= np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
        try:
            _, inliers = cv2.findFundamentalMat(before[mask], after[mask], self._ransac)
        except cv2.error:  # OpenCV fails on some degenerate sets.
            return mask
        if inliers is not None and inliers.mean() > MIN_INLIER_SHARE:
            mask[mask] = inliers[:, 0] > 0
        return mask

    def _refill(self, image: np.ndarray, survivors: _TrackState) -> _TrackState:
        """Add new corners away from the tracks, up to the number of features."""
        missing = self._features - len(survivors)
        if missing < 0.1 * self._features:
            return survivors
        corners = find_corners(image, survivors.points, missing)
        state = survivors.extend(self._next_id, corners)
        self._next_id += len(corners)
        return state


def _magsac_parameters(seed: int) -> cv2.UsacParams:
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
