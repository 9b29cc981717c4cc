# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test the track table of a window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from odometry_scenes import PointCloud, moving_poses

from kfvo_ros.backbones.geometric.observations import FrameTracks, build_track_table
from kfvo_ros.backbones.geometric.self_calibration import IntrinsicsFilter


def test_table_contains_the_tracks_of_moving_frames():
    cloud, poses = PointCloud(0), moving_poses(4)
    frames = [cloud.encode(index, pose).payload for index, pose in enumerate(poses)]
    table = build_track_table(frames, 1, IntrinsicsFilter())
    assert (np.diff(table.ids) > 0).all()
    assert (table.mask.sum(axis=1) >= 2).all()
    assert table.mask[:, 2:].any(axis=1).all()
    assert np.array_equal(table.hosts, table.mask.argmax(axis=1))
    for index, frame in enumerate(frames):
        rows = np.flatnonzero(table.mask[:, index])
        columns = np.searchsorted(frame.tracks.ids, table.ids[rows])
        assert np.array_equal(table.image_points[rows, index], frame.points[columns])
    rows = np.arange(len(table))
    assert np.array_equal(table.rays[:, :2], table.image_points[rows, table.hosts])


def test_certainty_follows_the_last_uncertainty_of_a_track():
    cloud, poses = PointCloud(0), moving_poses(3)
    frames = []
    for index, pose in enumerate(poses):
        frame = cloud.encode(index, pose).payload
        ids = frame.tracks.ids
        tracks = replace(frame.tracks, uncertainty=np.where(ids % 2 == 0, 0.0, 0.1 * index))
        observed = ids % 5 != index
        frames.append(FrameTracks(index, tracks.select(observed), frame.points[observed]))
    table = build_track_table(frames, 0, IntrinsicsFilter())
    last = table.mask.shape[1] - 1 - table.mask[:, ::-1].argmax(axis=1)
    assert set(last) == {1, 2}
    weights = np.where(table.ids % 2 == 0, 1.0, np.where(last == 1, 0.5, 0.2))
    np.testing.assert_allclose(table.certainty ** 2, weights)
