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
import poselib

from kfvo_ros.camera import Camera

FEATURES = 500
CELL = 64
"""New corners are spread over cells of this size [px]."""
MIN_DISTANCE = 12
"""Tracks start at least this far apart [px]."""
HARRIS = 0.04
"""Points whose gradients point one way, along an edge, are no corners: a track would slide."""
MIN_RESPONSE, TINY_RESPONSE = 1e-6, 1e-6
"""A corner's response must reach this share of the image's strongest, which is none if tiny."""
BORDER = 8
"""No corner starts, and no track survives within half of it, this close to the rim [px]."""

CLAHE_CLIP, CLAHE_TILES = 3.0, (8, 8)
FLOW = {'winSize': (21, 21), 'criteria': (3, 30, 0.01)}
FORWARD_LEVELS, BACKWARD_LEVELS = 4, 1
MAX_ROUND_TRIP = 0.7
"""A track is dropped when tracking it back misses its origin by more [px]."""

MAX_EPIPOLAR_ERROR = 1.5
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
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    return a.pixels[in_a], b.pixels[in_b]


class Tracker:
    """Follow corners through the frames of one sequence.

    `camera` lets the outlier test see straight epipolar lines through a distorting lens.
    """

    def __init__(self, camera: Camera | None = None, features: int = FEATURES,
                 seed: int = 0) -> None:
        self._camera = camera if camera and camera.distortion_model != 'none' else None
        self._features = features
        self._seed = seed
        self._equaliser = cv2.createCLAHE(CLAHE_CLIP, CLAHE_TILES)
        self._image: np.ndarray | None = None
        self._tracks = Tracks()
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
            return Tracks()
        start = self._tracks.pixels.astype(np.float32)
        end, found, _ = cv2.calcOpticalFlowPyrLK(last, image, start, None,
                                                 maxLevel=FORWARD_LEVELS, **FLOW)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(
            image, last, end, start.copy(), maxLevel=BACKWARD_LEVELS,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **FLOW)
        rim, size = BORDER // 2, np.array(image.shape[::-1])
        inside = ((end >= rim) & (end < size - rim)).all(axis=1)
        good = (found[:, 0] > 0) & (returned[:, 0] > 0) & inside
        good &= np.linalg.norm(back - start, axis=1) < MAX_ROUND_TRIP
        survivors = Tracks(self._tracks.ids[good], end[good].astype(np.float64))
        return survivors.select(self._agreeing(self._tracks.pixels[good], survivors.pixels))

    def _agreeing(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of the pairs that follow one epipolar geometry."""
        everyone = np.ones(len(before), dtype=bool)
        if len(before) < MIN_RANSAC_TRACKS:
            return everyone
        if self._camera is not None:
            focal = 0.5 * (self._camera.fx + self._camera.fy)
            before, after = (focal * self._camera.undistort(p) for p in (before, after))
            everyone &= np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
        options = {'max_epipolar_error': MAX_EPIPOLAR_ERROR, 'min_iterations': 50,
                   'max_iterations': 300, 'seed': self._seed}
        _, info = poselib.estimate_fundamental(before[everyone], after[everyone], options, {})
        inliers = np.array(info['inliers'], dtype=bool)
        if inliers.mean() > MIN_INLIER_SHARE:
            everyone[everyone] = inliers
        return everyone

    def _refill(self, image: np.ndarray, survivors: Tracks) -> Tracks:
        """Add corners where there are no tracks, up to the wanted number."""
        missing = self._features - len(survivors)
        if missing < 0.1 * self._features:
            return survivors
        corners = _find_corners(image, survivors.pixels, missing)
        ids = np.arange(self._next_id, self._next_id + len(corners))
        self._next_id += len(corners)
        return Tracks(np.concatenate([survivors.ids, ids]),
                      np.concatenate([survivors.pixels, corners]))


def _find_corners(image: np.ndarray, occupied: np.ndarray, count: int) -> np.ndarray:
    """Return up to `count` corners (N, 2), spread over the image, away from `occupied`."""
    response = cv2.cornerHarris(image, 3, 3, HARRIS)
    response[:BORDER] = response[-BORDER:] = 0.0
    response[:, :BORDER] = response[:, -BORDER:] = 0.0
    for x, y in occupied.round().astype(int):
        cv2.circle(response, (int(x), int(y)), MIN_DISTANCE, 0.0, -1)
    reach = np.ones((MIN_DISTANCE + 1, MIN_DISTANCE + 1), dtype=np.uint8)
    peaks = (response == cv2.dilate(response, reach)) & (
        response > MIN_RESPONSE * max(float(response.max()), TINY_RESPONSE))
    y, x = np.nonzero(peaks)
    strength = response[y, x]
    cell = (y // CELL) * (image.shape[1] // CELL + 1) + x // CELL
    order = np.lexsort((-strength, cell))
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    # The best of every cell first, then the second best of every cell, and so on.
    chosen = np.lexsort((-strength, rank))[:count]
    return np.column_stack([x[chosen], y[chosen]]).astype(np.float64)
