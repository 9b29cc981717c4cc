# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""First guesses for a window: from nothing, or from what the window before it found."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import poselib

from kfvo_ros import geometry
from kfvo_ros.backbones.base import WindowPrior
from kfvo_ros.backbones.geometric import numba_utils, triangulation
from kfvo_ros.backbones.geometric.bundle_adjustment import LEAST_INVERSE_DEPTH
from kfvo_ros.backbones.geometric.keyframe_history import HistoryFrames, history_of
from kfvo_ros.backbones.geometric.observations import TrackTable
from kfvo_ros.backbones.geometric.reprojection import State
from kfvo_ros.tracking import tracker

MIN_PAIR_TRACKS = 12
"""Two frames with fewer common tracks cannot start a window."""
MIN_FLOW = 2.0
"""A pair that moved less tells nothing of the relative pose [px]."""
ENOUGH_TRACKS, ENOUGH_FLOW = 100, 50.0
"""More common tracks, or more flow [px], do not make a pair better."""
MIN_RESECTION_POINTS, ENOUGH_POINTS = 6, 100
"""Of more than so many points only every second, or third, is resected from."""
NEIGHBOURS = 5
"""So many known points around it tell where a new one is expected."""
LEAST_SHARE, LARGEST_SHARE = 0.02, 50.0
"""Triangulated inverse depths are believed within these shares of the scene's median."""
MAX_SPREAD = 0.7
"""... and when one pixel moves them by less than this share of the median."""
LEAST_COSINE = 1e-3
"""Points at a steeper angle to the optical axis are not in front of a camera."""
RELATIVE_POSE = {'max_epipolar_error': 1.0, 'max_iterations': 500, 'min_iterations': 20}
ABSOLUTE_POSE = {'max_reproj_error': 3.0, 'max_iterations': 200, 'min_iterations': 5}
REFINEMENT = {'max_iterations': 5}
"""Of a pose that is adjusted with the whole window next."""


@dataclass(frozen=True)
class Guess:
    """Where to start, and the inverse depths (P,) to expect when nothing better is measured.

    ``trusted`` (P,) marks the points whose depths earlier windows measured well.
    """

    state: State
    expected_inverse_depths: np.ndarray
    trusted: np.ndarray


class Initialiser:
    """Minimal solvers on undistorted pixels: `focal` [px] times normalised coordinates."""

    def __init__(self, focal: float, seed: int) -> None:
        self.focal = focal
        self._seed = seed
        self._camera = {'model': 'SIMPLE_PINHOLE', 'width': 1, 'height': 1,
                        'params': [focal, 0.0, 0.0]}

    def best_pair(self, observations: TrackTable) -> tuple[int, int] | None:
        """Return the two frames whose relative pose is best determined, by tracks and flow.

        None when the camera did not move.
        """
        best, pair = 0.0, None
        frames = observations.mask.shape[1]
        for i in range(frames):
            for j in range(i + 1, frames):
                both = observations.mask[:, i] & observations.mask[:, j]
                if both.sum() < MIN_PAIR_TRACKS:
                    continue
                shift = observations.seen[both, i] - observations.seen[both, j]
                flow = self.focal * float(np.median(np.linalg.norm(shift, axis=1)))
                if flow < MIN_FLOW:
                    continue
                score = min(both.sum(), ENOUGH_TRACKS) * min(flow, ENOUGH_FLOW)
                if score > best:
                    best, pair = score, (i, j)
        return pair

    def from_nothing(self, observations: TrackTable, pair: tuple[int, int] | None) -> Guess:
        """Return poses and depths of a window of which nothing is known, median depth 1.

        The `best_pair` of frames gives the first two poses, the others are resected one by one
        from the points triangulated so far. Without one, a camera at rest, all points are at
        depth 1.
        """
        frames = observations.mask.shape[1]
        T_first_frame = np.tile(np.eye(4), (frames, 1, 1))
        if pair is not None:
            first, second = pair
            T_first_frame[second] = self._relative_pose(observations, first, second)
            placed = np.isin(np.arange(frames), pair)
            distance = np.minimum(abs(np.arange(frames) - first), abs(np.arange(frames) - second))
            for frame in np.argsort(distance, kind='stable')[2:]:
                nearest = min(np.flatnonzero(placed), key=lambda other: abs(other - frame))
                T_first_frame[frame] = self._resect_in_turn(
                    observations, T_first_frame, placed, frame, T_first_frame[nearest])
                placed[frame] = True
        T_anchor_frame = geometry.relative(T_first_frame[0], T_first_frame)
        unknown = np.full(len(observations), np.nan)
        state = self._complete(observations, T_anchor_frame, unknown)
        state = state.scaled(float(np.median(state.points[2])))
        return Guess(state, np.ones(len(observations)), np.zeros(len(observations), dtype=bool))

    def from_previous(self, observations: TrackTable, previous: WindowPrior, history: HistoryFrames,
                      by_epipolar_geometry: bool = False) -> Guess:
        """Return the poses and depths known from earlier windows, and a place for the new frame.

        It is resected from known points, or found by epipolar geometry from all its tracks since
        the last keyframe, which needs known points for the length of the step alone.
        """
        T_anchor_frame = _poses_before(previous, history)
        known = known_inverse_depths(observations, T_anchor_frame, previous)
        visible = np.isfinite(known) & observations.mask[:, -1]
        if by_epipolar_geometry:
            T_anchor_frame[-1] = self._step(observations, T_anchor_frame, known, visible)
        else:
            T_anchor_frame[-1] = self._resect(
                observations, T_anchor_frame, known, visible, len(T_anchor_frame) - 1,
                previous.T_anchor_latest)
        state = self._complete(observations, T_anchor_frame, known)
        return _guess(observations, previous, state, known)

    def from_history(self, observations: TrackTable, previous: WindowPrior,
                     history: HistoryFrames) -> Guess:
        """Return poses resected from what history and anchor see, which are final, and no other.

        What the last window took for motion of its frames, and for depths, is not built on:
        where the camera hovered and moves on, the two may be wrong together.
        """
        T_anchor_frame = _poses_before(previous, history)
        known = known_inverse_depths(observations, T_anchor_frame, previous)
        final = np.arange(len(T_anchor_frame)) <= len(history.views)
        for frame in range(len(history.views) + 1, len(T_anchor_frame)):
            T_anchor_frame[frame] = self._resect_in_turn(observations, T_anchor_frame, final,
                                                         frame, T_anchor_frame[frame])
        state = self._complete(observations, T_anchor_frame, np.full(len(observations), np.nan))
        return _guess(observations, previous, state, known)

    def _relative_pose(self, observations: TrackTable, i: int, j: int) -> np.ndarray:
        """Return T_i_j with a translation of length 1."""
        both = observations.mask[:, i] & observations.mask[:, j]
        pose, _ = poselib.estimate_relative_pose(
            self.focal * observations.seen[both, i], self.focal * observations.seen[both, j],
            self._camera, self._camera, RELATIVE_POSE | {'seed': self._seed}, {})
        T_i_j = _inverse_of(pose)
        length = np.linalg.norm(T_i_j[:3, 3])
        T_i_j[:3, 3] /= length if length > 0.0 else 1.0
        return T_i_j

    def _step(self, observations: TrackTable, T_anchor_frame: np.ndarray,
              inverse_depths: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return T_anchor_newest from the relative pose to the frame before it.

        The length of the step is the median of what each known point asks for: with X in the
        older frame and ray x in the newer, x x (R X + s t) = 0.
        """
        latest = T_anchor_frame[-1]
        newest, keyframe = len(T_anchor_frame) - 1, len(T_anchor_frame) - 2
        both = observations.mask[:, newest] & observations.mask[:, keyframe]
        if both.sum() < MIN_PAIR_TRACKS or visible.sum() < MIN_RESECTION_POINTS:
            return latest
        T_keyframe_newest = self._relative_pose(observations, keyframe, newest)
        T_newest_keyframe = geometry.invert(T_keyframe_newest)
        T_keyframe_frame = geometry.relative(T_anchor_frame[keyframe], T_anchor_frame)
        X = triangulation.point_positions(*_rotations_and_translations(T_keyframe_frame),
                                          observations.hosts[visible], observations.rays[visible],
                                          inverse_depths[visible])
        x = np.column_stack([observations.seen[visible, newest], np.ones(visible.sum())])
        turned = np.cross(x, X @ T_newest_keyframe[:3, :3].T)
        moved = np.cross(x, T_newest_keyframe[:3, 3])
        lengths = -(turned * moved).sum(axis=1) / np.maximum((moved * moved).sum(axis=1), 1e-12)
        T_keyframe_newest[:3, 3] *= max(float(np.median(lengths)), 0.0)
        return T_anchor_frame[keyframe] @ T_keyframe_newest

    def _resect_in_turn(self, observations: TrackTable, T_w_frame: np.ndarray,
                        placed: np.ndarray, frame: int, fallback: np.ndarray) -> np.ndarray:
        """Return T_w_frame of one more frame from points that two placed frames see."""
        mask = observations.mask & placed
        rows = np.flatnonzero((mask.sum(axis=1) >= 2) & observations.mask[:, frame])
        if len(rows) < MIN_RESECTION_POINTS:
            return fallback
        hosts = mask[rows].argmax(axis=1)
        rays = np.ones((len(rows), 3))
        rays[:, :2] = observations.seen[rows, hosts]
        part = TrackTable(observations.ids[rows], observations.seen[rows], mask[rows], hosts,
                          rays, observations.certainty[rows])
        inverse_depths, _ = _triangulate(part, T_w_frame)
        return self._resect(part, T_w_frame, inverse_depths,
                            inverse_depths > LEAST_INVERSE_DEPTH, frame, fallback)

    def _resect(self, observations: TrackTable, T_w_frame: np.ndarray,
                inverse_depths: np.ndarray, usable: np.ndarray, frame: int,
                fallback: np.ndarray) -> np.ndarray:
        """Return T_w_frame of `frame` from points of known depth."""
        if usable.sum() < MIN_RESECTION_POINTS:
            return fallback
        rows = np.flatnonzero(usable)
        rows = rows[::math.ceil(len(rows) / ENOUGH_POINTS)]
        positions = triangulation.point_positions(*_rotations_and_translations(T_w_frame),
                                                  observations.hosts[rows], observations.rays[rows],
                                                  inverse_depths[rows])
        pose, info = poselib.estimate_absolute_pose(
            self.focal * observations.seen[rows, frame], positions, self._camera,
            ABSOLUTE_POSE | {'seed': self._seed}, REFINEMENT)
        if info['num_inliers'] < MIN_RESECTION_POINTS:
            return fallback
        return _inverse_of(pose)

    def _complete(self, observations: TrackTable, T_anchor_frame: np.ndarray,
                  inverse_depths: np.ndarray) -> State:
        """Return the state with unknown (NaN) inverse depths triangulated, or the median's."""
        unknown = ~np.isfinite(inverse_depths)
        triangulated, weights = _triangulate(observations, T_anchor_frame)
        believed = triangulated > LEAST_INVERSE_DEPTH
        reference = triangulated[believed] if unknown.all() else inverse_depths[~unknown]
        median = numba_utils.median(reference) if len(reference) else 1.0
        believed &= ((triangulated > LEAST_SHARE * median)
                     & (triangulated < LARGEST_SHARE * median))
        believed &= self.focal * np.sqrt(weights) * MAX_SPREAD * median > 1.0
        filled = np.where(unknown, np.where(believed, triangulated, median), inverse_depths)
        return State(*_rotations_and_translations(T_anchor_frame),
                     np.stack([*observations.rays[:, :2].T, filled]))


def _poses_before(previous: WindowPrior, history: HistoryFrames) -> np.ndarray:
    """Return where earlier windows had history and frames, the new one where the camera was."""
    return np.concatenate([history.T_anchor_view, previous.T_anchor_frame,
                           previous.T_anchor_latest[None]])


def _guess(observations: TrackTable, previous: WindowPrior, state: State,
           known: np.ndarray) -> Guess:
    """Return the start, with what earlier windows let expect: inverse depths (P,) or NaN."""
    measured = tracker.present(observations.ids, history_of(previous).trusted)
    return Guess(state, _expect(observations, known, state.points[2]),
                 np.isfinite(known) & measured)


def known_inverse_depths(observations: TrackTable, T_anchor_frame: np.ndarray,
                         previous: WindowPrior) -> np.ndarray:
    """Return inverse depths (P,) in the hosts of points known before, NaN for new ones."""
    inverse_depths = np.full(len(observations), np.nan)
    if previous.points is None:
        return inverse_depths
    rows, known = tracker.shared(observations.ids, previous.points.ids)
    hosts = observations.hosts[rows]
    towards = previous.points.positions[known] - T_anchor_frame[hosts, :3, 3]
    depths = (T_anchor_frame[hosts, :3, 2] * towards).sum(axis=1)
    in_front = depths > LEAST_COSINE * np.linalg.norm(towards, axis=1)
    inverse_depths[rows[in_front]] = 1.0 / depths[in_front]
    return inverse_depths


def _expect(observations: TrackTable, known: np.ndarray, filled: np.ndarray) -> np.ndarray:
    """Return known inverse depths, and for new points those of their neighbours in the image.

    A new point is most likely as far as what is known around it in the newest frame; where
    nothing is, as the scene's median.
    """
    is_known = np.isfinite(known)
    median = numba_utils.median(known[is_known] if is_known.any() else filled)
    expected = np.where(is_known, known, median)
    visible = observations.mask[:, -1]
    old, new = np.flatnonzero(is_known & visible), np.flatnonzero(~is_known & visible)
    if len(old) >= NEIGHBOURS and len(new):
        points = observations.seen[:, -1]
        expected[new] = numba_utils.medians_of_nearest(points[new], points[old], known[old],
                                                       NEIGHBOURS)
    return expected


def _triangulate(observations: TrackTable,
                 T_anchor_frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return triangulation.triangulate(*_rotations_and_translations(T_anchor_frame), observations.hosts,
                                     observations.rays, observations.seen, observations.mask)


def _rotations_and_translations(transforms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what the kernels take of poses (F, 4, 4): (F, 3, 3) and (F, 3)."""
    return transforms[:, :3, :3].copy(), transforms[:, :3, 3].copy()


def _inverse_of(pose: Any) -> np.ndarray:
    """Return T_a_b (4, 4) of poselib's pose, which maps a to b."""
    return geometry.invert(geometry.make_transform(pose.R, pose.t))
