# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test outliers and covariance of a solved window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from odometry_scenes import CAMERA, PointCloud, moving_poses

from kfvo_ros.backbones.geometric.initialisation import Initialiser
from kfvo_ros.backbones.geometric.keyframe_history import HistoryFrames
from kfvo_ros.backbones.geometric.observations import FrameTracks, build_track_table
from kfvo_ros.backbones.geometric.self_calibration import IntrinsicsFilter
from kfvo_ros.backbones.geometric.window import Solution, solve


def solve_without_prior(frames: Sequence[FrameTracks]) -> Solution:
    """Return the solution of a stream's first window."""
    table = build_track_table(frames, 0, IntrinsicsFilter())
    return solve(table, Initialiser(CAMERA.fx, 0), None, HistoryFrames())


def test_jumping_track_is_an_outlier_in_spite_of_its_low_weight():
    cloud, poses = PointCloud(0), moving_poses(8)
    frames = [cloud.encode(index, pose).payload for index, pose in enumerate(poses)]
    newest = frames[-1]
    jumped = newest.tracks.ids[::7]
    wrong = np.isin(newest.tracks.ids, jumped)
    frames[-1] = FrameTracks(
        7, replace(newest.tracks, uncertainty=np.where(wrong, 3.0, 0.0)),
        newest.points + np.where(wrong, 30.0 / CAMERA.fx, 0.0)[:, None])
    solution = solve_without_prior(frames)
    assert not np.isin(jumped, solution.points.ids).any()
    assert solution.solved.mean() > 0.8


def test_covariance_of_a_frame_without_observations_is_large():
    cloud = PointCloud(0, noise=0.2)
    solution = solve_without_prior([cloud.encode(index, pose).payload
                                    for index, pose in enumerate(moving_poses(8))])
    mask = solution.problem.mask.copy()
    mask[-1] = False
    unobserved = replace(solution, problem=solution.problem._replace(mask=mask))
    usual, large = (np.trace(each.covariance()[-1]) for each in (solution, unobserved))
    assert np.isfinite(large) and large > 1000.0 * usual > 0.0
