# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the frames of a window see, and how far it is believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from odometry_scenes import CAMERA, PointCloud, moving_poses

from kfvo_ros.backbones.geometric.initialisation import Initialiser
from kfvo_ros.backbones.geometric.keyframe_history import HistoryFrames
from kfvo_ros.backbones.geometric.observations import FrameTracks, build_track_table
from kfvo_ros.backbones.geometric.self_calibration import IntrinsicsFilter
from kfvo_ros.backbones.geometric.window import solve


def test_table_lists_what_moving_frames_see():
    cloud, poses = PointCloud(0), moving_poses(4)
    views = [cloud.encode(index, pose).payload for index, pose in enumerate(poses)]
    table = build_track_table(views, 1, IntrinsicsFilter())
    assert (np.diff(table.ids) > 0).all()
    assert (table.mask.sum(axis=1) >= 2).all()
    assert table.mask[:, 2:].any(axis=1).all()
    assert np.array_equal(table.hosts, table.mask.argmax(axis=1))
    for frame, view in enumerate(views):
        rows = np.flatnonzero(table.mask[:, frame])
        columns = np.searchsorted(view.tracks.ids, table.ids[rows])
        assert np.array_equal(table.seen[rows, frame], view.points[columns])
    rows = np.arange(len(table))
    assert np.array_equal(table.rays[:, :2], table.seen[rows, table.hosts])


def test_table_believes_tracks_by_the_last_that_is_known_of_them():
    cloud, poses = PointCloud(0), moving_poses(3)
    views = []
    for index, pose in enumerate(poses):
        view = cloud.encode(index, pose).payload
        ids = view.tracks.ids
        tracks = replace(view.tracks, doubts=np.where(ids % 2 == 0, 0.0, 0.1 * index))
        views.append(FrameTracks(index, tracks.select(ids % 5 != index), view.points[ids % 5 != index]))
    table = build_track_table(views, 0, IntrinsicsFilter())
    last = table.mask.shape[1] - 1 - table.mask[:, ::-1].argmax(axis=1)
    assert set(last) == {1, 2}
    weights = np.where(table.ids % 2 == 0, 1.0, np.where(last == 1, 0.5, 0.2))
    np.testing.assert_allclose(table.certainty ** 2, weights)


def test_a_track_that_jumps_is_an_outlier_however_little_it_is_believed():
    cloud, poses = PointCloud(0), moving_poses(8)
    views = [cloud.encode(index, pose).payload for index, pose in enumerate(poses)]
    jumped = views[-1].tracks.ids[::7]
    wrong = np.isin(views[-1].tracks.ids, jumped)
    views[-1] = FrameTracks(7, replace(views[-1].tracks, doubts=np.where(wrong, 3.0, 0.0)),
                            views[-1].points + np.where(wrong, 30.0 / CAMERA.fx, 0.0)[:, None])
    solution = solve(build_track_table(views, 0, IntrinsicsFilter()), Initialiser(CAMERA.fx, 0), None, HistoryFrames())
    assert not np.isin(jumped, solution.points.ids).any()
    assert solution.solved.mean() > 0.8


def test_a_frame_that_sees_nothing_may_be_anywhere():
    cloud = PointCloud(0, noise=0.2)
    views = [cloud.encode(index, pose).payload for index, pose in enumerate(moving_poses(8))]
    solution = solve(build_track_table(views, 0, IntrinsicsFilter()), Initialiser(CAMERA.fx, 0), None, HistoryFrames())
    mask = solution.problem.mask.copy()
    mask[-1] = False
    blind = replace(solution, problem=solution.problem._replace(mask=mask))
    seeing, unseeing = (np.trace(each.covariance()[-1]) for each in (solution, blind))
    assert np.isfinite(unseeing) and unseeing > 1000.0 * seeing > 0.0
