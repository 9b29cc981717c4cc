# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Who sees what in a window: tracks as a table of points by frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kfvo_ros.backbones.geometric.numba_utils import compiled
from kfvo_ros.backbones.geometric.self_calibration import IntrinsicsFilter
from kfvo_ros.tracking.tracker import Tracks

HALF_BELIEVED = 0.1
"""A track whose patches part by so much in each frame weighs half as much as one that is sure
[px]."""
END = np.iinfo(np.int64).max
"""No track has this id."""


@dataclass(frozen=True)
class FrameTracks:
    """What one frame sees: ``tracks`` in pixels, and where they lie undistorted.

    ``points`` (N, 2) are normalised, undistorted coordinates of the same tracks, by the
    calibration; ``index`` counts the input frames of the stream.
    """

    index: int
    tracks: Tracks
    points: np.ndarray


@dataclass(frozen=True)
class TrackTable:
    """The tracks that at least two of F frames see.

    ``ids`` (P,) increasing; ``seen`` (P, F, 2) normalised coordinates under ``mask`` (P, F);
    ``hosts`` (P,) the first frame that sees a point and ``rays`` (P, 3) its ray there; its tracks
    are to be believed ``certainty`` (P,) times as much as the best.
    """

    ids: np.ndarray
    seen: np.ndarray
    mask: np.ndarray
    hosts: np.ndarray
    rays: np.ndarray
    certainty: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)


def build_track_table(views: Sequence[FrameTracks], anchor: int, lens: IntrinsicsFilter) -> TrackTable:
    """Gather the tracks of `views`, oldest first, that a frame after the anchor sees."""
    ids, seen, mask, hosts, doubts = merge_tracks(
        np.concatenate([view.tracks.ids for view in views]),
        lens.straighten(np.concatenate([view.points for view in views])),
        np.concatenate([view.tracks.doubts for view in views]),
        np.cumsum([len(view.points) for view in views]), anchor + 1)
    rays = np.ones((len(ids), 3))
    rays[:, :2] = seen[np.arange(len(ids)), hosts]
    return TrackTable(ids, seen, mask, hosts, rays,
                      1.0 / np.sqrt(1.0 + np.square(doubts / HALF_BELIEVED)))


@compiled
def merge_tracks(ids, points, doubts, ends, first_moving):
    """Return the tracks (ids, seen, mask, hosts, doubts) that two views see, one of them moving.

    `ids` (N,), `points` (N, 2) and `doubts` (N,) are those of all views, one after the other; each
    view's ids increase, and end before `ends` (F,). Views from `first_moving` on move. Of doubts
    the last one counts.
    """
    frames, count = len(ends), 0
    heads = np.zeros(frames, dtype=np.int64)
    for frame in range(1, frames):
        heads[frame] = ends[frame - 1]
    merged = np.empty(len(ids) // 2, dtype=np.int64)
    seen = np.empty((len(merged), frames, 2))
    mask = np.empty((len(merged), frames), dtype=np.bool_)
    hosts, doubted = np.empty(len(merged), dtype=np.int64), np.empty(len(merged))
    while True:
        lowest, views, first, last = END, 0, -1, -1
        for frame in range(frames):
            head = heads[frame]
            if head < ends[frame] and ids[head] <= lowest:
                if ids[head] < lowest:
                    lowest, views, first = ids[head], 0, frame
                views, last = views + 1, frame
        if views == 0:
            return merged[:count], seen[:count], mask[:count], hosts[:count], doubted[:count]
        wanted = views >= 2 and last >= first_moving
        if wanted:
            merged[count], hosts[count], doubted[count] = lowest, first, doubts[heads[last]]
        for frame in range(frames):
            head = heads[frame]
            sees = head < ends[frame] and ids[head] == lowest
            heads[frame] += sees
            if wanted:
                mask[count, frame] = sees
                seen[count, frame, 0] = points[head, 0] if sees else 0.0
                seen[count, frame, 1] = points[head, 1] if sees else 0.0
        count += wanted
