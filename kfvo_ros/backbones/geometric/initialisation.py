# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Initial guesses for a window: bootstrapped, or from the poses and points of earlier windows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import poselib

from kfvo_ros import geometry
from kfvo_ros.backbones.base import WindowPrior
from kfvo_ros.backbones.geometric import numba_utils, triangulation
from kfvo_ros.backbones.geometric.bundle_adjustment import MIN_INVERSE_DEPTH
from kfvo_ros.backbones.geometric.keyframe_history import HistoryFrames, history_of
from kfvo_ros.backbones.geometric.observations import TrackTable
from kfvo_ros.backbones.geometric.reprojection import State
from kfvo_ros.tracking import tracker

MIN_PAIR_TRACKS = 12
"""Least number of common tracks for the relative pose of two frames."""
MIN_FLOW = 2.0
"""Least median flow for the relative pose of two frames [px]."""
ENOUGH_TRACKS, ENOUGH_FLOW = 100, 50.0
"""More common tracks, or more flow [px], do not make a pair better."""
MIN_RESECTION_POINTS, ENOUGH_POINTS = 6, 100
"""Resection takes every n-th point so that it has at most ENOUGH_POINTS."""
NEIGHBOURS = 5
"""Number of known points that a new point's expected depth is the median of."""
MIN_SHARE, MAX_SHARE = 0.02, 50.0
"""Triangulated inverse depths are accepted within these shares of the scene's median ..."""
MAX_SPREAD = 0.7
"""... and when one pixel changes them by less than this share of the median."""
MIN_COSINE = 1e-3
"""Points at a steeper angle to the optical axis are not in front of a camera."""
RELATIVE_POSE = {'max_epipolar_error': 1.0, 'max_iterations': 500, 'min_iterations': 20}
ABSOLUTE_POSE = {'max_reproj_error': 3.0, 'max_iterations': 200, 'min_iterations': 5}
REFINEMENT = {'max_iterations': 5}
"""Few iterations: bundle adjustment follows."""


@dataclass(frozen=True)
class InitialGuess:
    """Start of an adjustment, and the inverse depths (P,) that its priors draw points to.

    ``trusted`` (P,) marks points whose depths earlier windows measured well.
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

    def best_pair(self, table: TrackTable) -> tuple[int, int] | None:
        """Return the two frames whose relative pose is best determined, by tracks and flow.

        None when the camera did not move.
        """
        best, pair = 0.0, None
        frames = table.mask.shape[1]
        for i in range(frames):
            for j in range(i + 1, frames):
                both = table.mask[:, i] & table.mask[:, j]
                if both.sum() < MIN_PAIR_TRACKS:
                    continue
                shift = table.image_points[both, i] - table.image_points[both, j]
                flow = self.focal * float(np.median(np.linalg.norm(shift, axis=1)))
                if flow < MIN_FLOW:
                    continue
                score = min(both.sum(), ENOUGH_TRACKS) * min(flow, ENOUGH_FLOW)
                if score > best:
                    best, pair = score, (i, j)
        return pair

    def bootstrap(self, table: TrackTable, pair: tuple[int, int] | None) -> InitialGuess:
        """Return a guess from the tracks alone, in units of the median depth.

        The relative pose of the `best_pair` comes first; the other frames are resected one by one
        from the points triangulated so far. Without a pair the camera is at rest and all points
        are at depth 1.
        """
        frames = table.mask.shape[1]
        T_first_frame = np.tile(np.eye(4), (frames, 1, 1))
        if pair is not None:
            first, second = pair
            T_first_frame[second] = self._relative_pose(table, first, second)
            placed = np.isin(np.arange(frames), pair)
            distance = np.minimum(abs(np.arange(frames) - first), abs(np.arange(frames) - second))
            for frame in np.argsort(distance, kind='stable')[2:]:
                nearest = min(np.flatnonzero(placed), key=lambda other: abs(other - frame))
                T_first_frame[frame] = self._triangulate_and_resect(
                    table, T_first_frame, placed, frame, T_first_frame[nearest])
                placed[frame] = True
        T_anchor_frame = geometry.relative(T_first_frame[0], T_first_frame)
        unknown = np.full(len(table), np.nan)
        state = self._complete_depths(table, T_anchor_frame, unknown)
        state = state.scaled(float(np.median(state.points[2])))
        return InitialGuess(state, np.ones(len(table)), np.zeros(len(table), dtype=bool))

    def from_prior(self, table: TrackTable, prior: WindowPrior, history: HistoryFrames,
                   by_epipolar_geometry: bool = False) -> InitialGuess:
        """Return the poses and depths of earlier windows, and a pose for the newest frame.

        The newest frame is resected from known points. `by_epipolar_geometry`, its pose comes
        from all tracks since the last keyframe and known points give only the length of the step.
        """
        T_anchor_frame = _prior_poses(prior, history)
        known = known_inverse_depths(table, T_anchor_frame, prior)
        visible = np.isfinite(known) & table.mask[:, -1]
        if by_epipolar_geometry:
            T_anchor_frame[-1] = self._epipolar_pose(table, T_anchor_frame, known, visible)
        else:
            T_anchor_frame[-1] = self._resect(table, T_anchor_frame, known, visible,
                                              len(T_anchor_frame) - 1, prior.T_anchor_latest)
        state = self._complete_depths(table, T_anchor_frame, known)
        return _with_expected_depths(table, prior, state, known)

    def from_history(self, table: TrackTable, prior: WindowPrior,
                     history: HistoryFrames) -> InitialGuess:
        """Return poses of all later frames, resected from tracks of history and anchor alone.

        Ignores the previous window's poses and depths: where the camera hovered before it moves
        on, both may be wrong together.
        """
        T_anchor_frame = _prior_poses(prior, history)
        known = known_inverse_depths(table, T_anchor_frame, prior)
        final = np.arange(len(T_anchor_frame)) <= len(history.frames)
        for frame in range(len(history.frames) + 1, len(T_anchor_frame)):
            T_anchor_frame[frame] = self._triangulate_and_resect(
                table, T_anchor_frame, final, frame, T_anchor_frame[frame])
        state = self._complete_depths(table, T_anchor_frame, np.full(len(table), np.nan))
        return _with_expected_depths(table, prior, state, known)

    def _relative_pose(self, table: TrackTable, i: int, j: int) -> np.ndarray:
        """Return T_i_j with a translation of length 1."""
        both = table.mask[:, i] & table.mask[:, j]
        pose, _ = poselib.estimate_relative_pose(
            self.focal * table.image_points[both, i], self.focal * table.image_points[both, j],
            self._camera, self._camera, RELATIVE_POSE | {'seed': self._seed}, {})
        T_i_j = _inverse_transform(pose)
        length = np.linalg.norm(T_i_j[:3, 3])
        T_i_j[:3, 3] /= length if length > 0.0 else 1.0
        return T_i_j

    def _epipolar_pose(self, table: TrackTable, T_anchor_frame: np.ndarray,
                       inverse_depths: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return T_anchor_newest from the relative pose to the frame before it.

        Each known point X in the older frame with ray x in the newer one gives a length s of the
        step, x x (R X + s t) = 0. The median is taken.
        """
        latest = T_anchor_frame[-1]
        newest, keyframe = len(T_anchor_frame) - 1, len(T_anchor_frame) - 2
        both = table.mask[:, newest] & table.mask[:, keyframe]
        if both.sum() < MIN_PAIR_TRACKS or visible.sum() < MIN_RESECTION_POINTS:
            return latest
        T_keyframe_newest = self._relative_pose(table, keyframe, newest)
        T_newest_keyframe = geometry.invert(T_keyframe_newest)
        T_keyframe_frame = geometry.relative(T_anchor_frame[keyframe], T_anchor_frame)
        X = triangulation.point_positions(*_rotations_and_translations(T_keyframe_frame),
                                          table.hosts[visible], table.rays[visible],
                                          inverse_depths[visible])
        x = np.column_stack([table.image_points[visible, newest], np.ones(visible.sum())])
        rotated = np.cross(x, X @ T_newest_keyframe[:3, :3].T)
        moved = np.cross(x, T_newest_keyframe[:3, 3])
        lengths = -(rotated * moved).sum(axis=1) / np.maximum((moved * moved).sum(axis=1), 1e-12)
        T_keyframe_newest[:3, 3] *= max(float(np.median(lengths)), 0.0)
        return T_anchor_frame[keyframe] @ T_keyframe_newest

    def _triangulate_and_resect(self, table: TrackTable, T_w_frame: np.ndarray,
                                placed: np.ndarray, frame: int,
                                fallback: np.ndarray) -> np.ndarray:
        """Return T_w_frame of one more frame from points that two placed frames observe."""
        mask = table.mask & placed
        rows = np.flatnonzero((mask.sum(axis=1) >= 2) & table.mask[:, frame])
        if len(rows) < MIN_RESECTION_POINTS:
            return fallback
        hosts = mask[rows].argmax(axis=1)
        rays = np.ones((len(rows), 3))
        rays[:, :2] = table.image_points[rows, hosts]
        part = TrackTable(table.ids[rows], table.image_points[rows], mask[rows], hosts, rays,
                          table.certainty[rows])
        inverse_depths, _ = _triangulate(part, T_w_frame)
        return self._resect(part, T_w_frame, inverse_depths, inverse_depths > MIN_INVERSE_DEPTH,
                            frame, fallback)

    def _resect(self, table: TrackTable, T_w_frame: np.ndarray, inverse_depths: np.ndarray,
                usable: np.ndarray, frame: int, fallback: np.ndarray) -> np.ndarray:
        """Return T_w_frame of `frame` from points of known depth."""
        if usable.sum() < MIN_RESECTION_POINTS:
            return fallback
        rows = np.flatnonzero(usable)
        rows = rows[::math.ceil(len(rows) / ENOUGH_POINTS)]
        positions = triangulation.point_positions(*_rotations_and_translations(T_w_frame),
                                                  table.hosts[rows], table.rays[rows],
                                                  inverse_depths[rows])
        pose, info = poselib.estimate_absolute_pose(
            self.focal * table.image_points[rows, frame], positions, self._camera,
            ABSOLUTE_POSE | {'seed': self._seed}, REFINEMENT)
        if info['num_inliers'] < MIN_RESECTION_POINTS:
            return fallback
        return _inverse_transform(pose)

    def _complete_depths(self, table: TrackTable, T_anchor_frame: np.ndarray,
                         inverse_depths: np.ndarray) -> State:
        """Return the state with unknown (NaN) inverse depths triangulated, or else the median."""
        unknown = ~np.isfinite(inverse_depths)
        triangulated, weights = _triangulate(table, T_anchor_frame)
        accepted = triangulated > MIN_INVERSE_DEPTH
        reference = triangulated[accepted] if unknown.all() else inverse_depths[~unknown]
        median = numba_utils.median(reference) if len(reference) else 1.0
        accepted &= (triangulated > MIN_SHARE * median) & (triangulated < MAX_SHARE * median)
        accepted &= self.focal * np.sqrt(weights) * MAX_SPREAD * median > 1.0
        filled = np.where(unknown, np.where(accepted, triangulated, median), inverse_depths)
        return State(*_rotations_and_translations(T_anchor_frame),
                     np.stack([*table.rays[:, :2].T, filled]))


def known_inverse_depths(table: TrackTable, T_anchor_frame: np.ndarray,
                         prior: WindowPrior) -> np.ndarray:
    """Return inverse depths (P,) in the hosts of the prior's points, NaN for new points."""
    inverse_depths = np.full(len(table), np.nan)
    if prior.points is None:
        return inverse_depths
    rows, known = tracker.match_ids(table.ids, prior.points.ids)
    hosts = table.hosts[rows]
    towards = prior.points.positions[known] - T_anchor_frame[hosts, :3, 3]
    depths = (T_anchor_frame[hosts, :3, 2] * towards).sum(axis=1)
    in_front = depths > MIN_COSINE * np.linalg.norm(towards, axis=1)
    inverse_depths[rows[in_front]] = 1.0 / depths[in_front]
    return inverse_depths


def _prior_poses(prior: WindowPrior, history: HistoryFrames) -> np.ndarray:
    """Return T_anchor_frame of history, keyframes and newest frame, the last as the latest."""
    return np.concatenate([history.T_anchor_frame, prior.T_anchor_frame,
                           prior.T_anchor_latest[None]])


def _with_expected_depths(table: TrackTable, prior: WindowPrior, state: State,
                          known: np.ndarray) -> InitialGuess:
    """Return a guess at `state`; `known` inverse depths (P,) are NaN for new points."""
    measured = tracker.ids_in(table.ids, history_of(prior).trusted_ids)
    return InitialGuess(state, _expected_inverse_depths(table, known, state.points[2]),
                        np.isfinite(known) & measured)


def _expected_inverse_depths(table: TrackTable, known: np.ndarray,
                             filled: np.ndarray) -> np.ndarray:
    """Return `known` inverse depths (P,) where finite, else those of neighbours in the image.

    A new point gets the median of the nearest known points in the newest frame, or the scene's
    median where there are none; that of `filled` (P,) when no point is known.
    """
    is_known = np.isfinite(known)
    median = numba_utils.median(known[is_known] if is_known.any() else filled)
    expected = np.where(is_known, known, median)
    visible = table.mask[:, -1]
    old, new = np.flatnonzero(is_known & visible), np.flatnonzero(~is_known & visible)
    if len(old) >= NEIGHBOURS and len(new):
        points = table.image_points[:, -1]
        expected[new] = numba_utils.medians_of_nearest(points[new], points[old], known[old],
                                                       NEIGHBOURS)
    return expected


def _triangulate(table: TrackTable, T_w_frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return triangulation.triangulate(*_rotations_and_translations(T_w_frame), table.hosts,
                                     table.rays, table.image_points, table.mask)


def _rotations_and_translations(transforms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return contiguous rotations (F, 3, 3) and translations (F, 3) of transforms (F, 4, 4)."""
    return transforms[:, :3, :3].copy(), transforms[:, :3, 3].copy()


def _inverse_transform(pose: Any) -> np.ndarray:
    """Return T_a_b (4, 4) of poselib's pose, which maps a to b."""
    return geometry.invert(geometry.make_transform(pose.R, pose.t))
