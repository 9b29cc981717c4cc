# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Track table of a window: points x frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import float64, int64

from kfvo_ros.backbones.geometric.numba_utils import compiled, entry_point
from kfvo_ros.backbones.geometric.self_calibration import IntrinsicsFilter
from kfvo_ros.tracking.tracker import Tracks

HALF_WEIGHT_UNCERTAINTY = 0.1
"""Uncertainty of a track with half the weight of a certain one [px]."""
MIN_TRACKS = 12
"""Least number of tracks, and of inliers, by which a frame is located."""
MAX_ID = np.iinfo(np.int64).max
"""Greater than all track ids."""


@dataclass(frozen=True)
class FrameTracks:
    """Observations of one frame: ``tracks`` in pixels and as undistorted ``points``.

    ``points`` (N, 2) are normalised coordinates of the same tracks, undistorted by the
    calibration; ``index`` counts the input frames of the stream.
    """

    index: int
    tracks: Tracks
    points: np.ndarray

    @property
    def blind(self) -> bool:
        """Whether the tracks are too few to locate this frame, or any frame relative to it."""
        return len(self.tracks) < MIN_TRACKS


@dataclass(frozen=True)
class TrackTable:
    """P tracks that at least two of F frames observe.

    ``ids`` (P,) increase; ``image_points`` (P, F, 2) are normalised coordinates under ``mask``
    (P, F); ``hosts`` (P,) are the first frames that observe a point and ``rays`` (P, 3) its rays
    there; ``certainty`` (P,) is the weight of residuals, 1 for tracks without uncertainty.
    """

    ids: np.ndarray
    image_points: np.ndarray
    mask: np.ndarray
    hosts: np.ndarray
    rays: np.ndarray
    certainty: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)


def build_track_table(frames: Sequence[FrameTracks], anchor: int,
                      intrinsics_filter: IntrinsicsFilter) -> TrackTable:
    """Return the tracks of `frames`, oldest first, that a frame after the anchor observes."""
    ids, image_points, mask, hosts, uncertainty = merge_tracks(
        np.concatenate([frame.tracks.ids for frame in frames]),
        intrinsics_filter.undistort(np.concatenate([frame.points for frame in frames])),
        np.concatenate([frame.tracks.uncertainty for frame in frames]),
        np.cumsum([len(frame.points) for frame in frames]), anchor + 1)
    rays = np.ones((len(ids), 3))
    rays[:, :2] = image_points[np.arange(len(ids)), hosts]
    return TrackTable(ids, image_points, mask, hosts, rays,
                      1.0 / np.sqrt(1.0 + np.square(uncertainty / HALF_WEIGHT_UNCERTAINTY)))


@entry_point(int64[::1], float64[:, ::1], float64[::1], int64[::1], int64)
def merge_tracks(ids: np.ndarray, points: np.ndarray, uncertainty: np.ndarray, ends: np.ndarray,
                 first_moving: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray,
                                             np.ndarray]:
    """Return ids, image points, mask, hosts and uncertainty of the tracks of a `TrackTable`.

    `ids` (N,), `points` (N, 2) and `uncertainty` (N,) are the frames' concatenated tracks. Each
    frame's ids increase and stop before its entry of `ends` (F,). A track is kept when two frames
    observe it, of which one is at or after `first_moving`; its last uncertainty counts.
    """
    frames, capacity, count = len(ends), len(ids) // 2, 0
    kept_ids, hosts = np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64)
    image_points = np.empty((capacity, frames, 2))
    mask = np.empty((capacity, frames), dtype=np.bool_)
    kept_uncertainty = np.empty(capacity)
    heads = np.zeros(frames, dtype=np.int64)  # Each frame's first track that is not merged yet.
    for frame in range(1, frames):
        heads[frame] = ends[frame - 1]
    while True:
        track_id, observations, first, last = _next_track(ids, heads, ends)
        if observations == 0:
            return (kept_ids[:count], image_points[:count], mask[:count], hosts[:count],
                    kept_uncertainty[:count])
        if observations >= 2 and last >= first_moving:
            kept_ids[count], hosts[count] = track_id, first
            kept_uncertainty[count] = uncertainty[heads[last]]
            _fill_row(track_id, ids, points, heads, ends, image_points[count], mask[count])
            count += 1
        for frame in range(first, last + 1):
            heads[frame] += heads[frame] < ends[frame] and ids[heads[frame]] == track_id


@compiled
def _next_track(ids: np.ndarray, heads: np.ndarray,
                ends: np.ndarray) -> tuple[int, int, int, int]:
    """Return the lowest id at the heads, its number of observations, its first and last frame.

    There are 0 observations after the last track.
    """
    lowest, observations, first, last = MAX_ID, 0, -1, -1
    for frame in range(len(ends)):
        head = heads[frame]
        if head < ends[frame] and ids[head] <= lowest:
            if ids[head] < lowest:
                lowest, observations, first = ids[head], 0, frame
            observations, last = observations + 1, frame
    return lowest, observations, first, last


@compiled
def _fill_row(track_id: int, ids: np.ndarray, points: np.ndarray, heads: np.ndarray,
              ends: np.ndarray, image_points: np.ndarray, mask: np.ndarray) -> None:
    """Fill a track's image points (F, 2) and mask (F,) from the heads that it is at."""
    for frame in range(len(ends)):
        head = heads[frame]
        observed = head < ends[frame] and ids[head] == track_id
        mask[frame] = observed
        image_points[frame, 0] = points[head, 0] if observed else 0.0
        image_points[frame, 1] = points[head, 1] if observed else 0.0
