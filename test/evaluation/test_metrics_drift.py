# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""KITTI's drift: by hand, and against a frame-by-frame form of the devkit's definition."""

from __future__ import annotations

import numpy as np
import pytest
from trajectories import along_x, evo_kitti, perturbed, random_walk, stamps_of, trajectory

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation.metrics import (
    KITTI_LENGTHS_M,
    absolute_trajectory_error,
    associate_trajectories,
    kitti_drift,
)
from kfvo_ros.trajectory import Trajectory, read_kitti_poses

# Frames 1 m apart. A sub-sequence ends where the path is longer than its length, not as long.
LINE = along_x(*range(1001))
STARTS = {length: [start for start in range(0, 1001, 10) if start + length + 1 <= 1000]
          for length in KITTI_LENGTHS_M}
MEAN_EXCESS = np.mean([(length + 1) / length for length in KITTI_LENGTHS_M
                       for _ in STARTS[length]])


def devkit_drift(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Return translation [%] and rotation [deg/100 m], frame by frame as in the devkit."""
    distances = [0.0]
    for before, after in zip(truth.positions, truth.positions[1:]):
        distances.append(distances[-1] + np.sqrt(np.sum((after - before) ** 2)))
    trans, rot = [], []
    for first in range(0, len(truth), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = next((frame for frame in range(first, len(truth))
                         if distances[frame] > distances[first] + length), None)
            if last is None:
                continue
            delta_true = np.linalg.inv(truth.poses[first]) @ truth.poses[last]
            delta_estimated = np.linalg.inv(estimate.poses[first]) @ estimate.poses[last]
            error = np.linalg.inv(delta_estimated) @ delta_true
            cosine = 0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1.0)
            trans.append(np.sqrt(np.sum(error[:3, 3] ** 2)) / length)
            rot.append(np.arccos(max(min(cosine, 1.0), -1.0)) / length)
    return 100.0 * np.mean(trans), 100.0 * np.rad2deg(np.mean(rot))


def assert_agrees_with_devkit(estimate: Trajectory, truth: Trajectory) -> None:
    """Check the drift with and without scale."""
    estimate, truth = associate_trajectories(estimate, truth)
    scaled = estimate.poses.copy()
    scaled[:, :3, 3] *= absolute_trajectory_error(estimate, truth).alignment.scale
    for poses, with_scale in ((estimate.poses, False), (scaled, True)):
        drift = kitti_drift(estimate, truth, with_scale)
        trans, rot = devkit_drift(Trajectory(estimate.stamps_ns, poses), truth)
        assert drift.trans_percent == pytest.approx(trans, rel=1e-9)
        # The devkit's arc cosine resolves small angles to seven digits only.
        assert drift.rot_deg_per_100m == pytest.approx(rot, rel=1e-6)


def test_one_percent_of_scale_is_one_percent_of_drift():
    estimate = trajectory(1.01 * LINE.positions)
    drift = kitti_drift(estimate, LINE, with_scale=False)
    assert drift.trans_percent == pytest.approx(1.0 * MEAN_EXCESS, rel=1e-12)
    assert drift.rot_deg_per_100m == 0.0
    assert kitti_drift(estimate, LINE).trans_percent == pytest.approx(0.0, abs=1e-12)


def test_a_constant_turn_per_metre_is_the_rotational_drift():
    steps = geometry.make_transform(geometry.exp_so3([0.0, 0.0, np.radians(0.01)]), [1.0, 0, 0])
    poses = [np.eye(4)]
    for _ in range(1000):
        poses.append(poses[-1] @ steps)
    drift = kitti_drift(Trajectory(LINE.stamps_ns, np.array(poses)), LINE, with_scale=False)
    assert drift.rot_deg_per_100m == pytest.approx(1.0 * MEAN_EXCESS, rel=1e-9)
    # A circle instead of its tangent: half the angle, 0.005 deg/m, times the length.
    np.testing.assert_allclose(drift.trans[drift.lengths == 100],
                               np.radians(0.005) * 101 / 100 * 100 * 101, rtol=0.02)


def test_sub_sequences_start_at_every_tenth_frame_and_end_beyond_their_length():
    drift = kitti_drift(LINE, LINE)
    assert drift.trans_percent == pytest.approx(0.0, abs=1e-9)
    for length, starts in STARTS.items():
        of_length = drift.lengths == length
        assert drift.first[of_length].tolist() == starts
        assert drift.last[of_length].tolist() == [start + length + 1 for start in starts]


@pytest.mark.parametrize('metres, reached', [(100.0, False), (100.5, True)])
def test_a_path_must_be_longer_than_the_shortest_length(metres, reached):
    path = along_x(0.0, 30.0, 60.0, metres)
    if reached:
        assert len(kitti_drift(path, path).first) == 1
        return
    with pytest.raises(KfvoError, match='a path of more than 100 m .* is 100.0 m long'):
        kitti_drift(path, path)


def test_positions_without_rotation_have_no_drift():
    with pytest.raises(KfvoError, match='positions without rotation'):
        kitti_drift(LINE, Trajectory(LINE.stamps_ns, LINE.poses, has_rotation=False))


@pytest.mark.parametrize('seed', range(3))
def test_drift_of_random_walks_agrees_with_the_devkit(seed):
    truth = random_walk(seed, 900)
    poses = truth.poses.copy()
    poses[:, :3, 3] *= 3.0
    truth = Trajectory(truth.stamps_ns, poses)
    assert truth.path_length > 900.0
    assert_agrees_with_devkit(perturbed(truth, seed + 50), truth)


def test_drift_of_a_car_agrees_with_the_devkit(data_path):
    stamps_ns = stamps_of(data_path('kitti/sequences/03/times.txt'))
    truth = read_kitti_poses(data_path('kitti/poses/03.txt'), stamps_ns)
    assert_agrees_with_devkit(perturbed(truth, 1, trans=0.3), truth)


@pytest.mark.parametrize('name', ['ORB', 'SPTAM'])
def test_drift_of_published_estimates_agrees_with_the_devkit(name):
    truth = evo_kitti('gt')
    assert_agrees_with_devkit(evo_kitti(name), truth)
