# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the camera to the base that carries it: frames, axes, velocities and covariances."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.odometry.base_motion import T_BODY_OPTICAL, UNKNOWN_VARIANCE, base_motion, base_pose
from kfvo_ros.odometry.online import OnlinePose
from kfvo_ros.trajectory import NANOSECONDS

LEVER = geometry.make_transform(geometry.exp_so3(np.array([0.3, -1.2, 0.5])),
                                np.array([0.4, -0.2, 1.1]))
POSE = geometry.make_transform(geometry.exp_so3(np.array([-0.7, 0.4, 1.9])),
                               np.array([3.0, -2.0, 0.5]))
MOTION = geometry.make_transform(geometry.exp_so3(np.array([0.02, 0.05, -0.03])),
                                 np.array([0.1, 0.02, 0.3]))
INTERVAL_NS = NANOSECONDS // 20


def covariance(seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6))
    return 1e-4 * (root @ root.T + np.eye(6))


def live_pose(pose: np.ndarray, motion: np.ndarray | None = None) -> OnlinePose:
    return OnlinePose(7, pose, covariance(1), Status.OK, True, motion,
                      0 if motion is None else INTERVAL_NS, covariance(2))


@pytest.mark.parametrize(('camera', 'base'), [
    ((0, 0, 1), (1, 0, 0)), ((1, 0, 0), (0, -1, 0)), ((0, 1, 0), (0, 0, -1))])
def test_axes_are_those_of_rep_103(camera, base):
    moved = geometry.make_transform(geometry.exp_so3(0.1 * np.array(camera)), np.array(camera))
    pose = base_pose(moved, T_BODY_OPTICAL)
    np.testing.assert_allclose(pose[:3, 3], base, atol=1e-12)
    np.testing.assert_allclose(geometry.log_so3(pose[:3, :3]), 0.1 * np.array(base), atol=1e-12)


def test_a_camera_that_turns_about_the_base_leaves_it_in_its_place():
    turn = geometry.make_transform(geometry.exp_so3(np.array([0.0, 0.0, 0.8])), np.zeros(3))
    T_world_camera = geometry.invert(LEVER) @ turn @ LEVER
    assert np.linalg.norm(T_world_camera[:3, 3]) > 0.1
    np.testing.assert_allclose(base_pose(T_world_camera, LEVER), turn, atol=1e-12)


def test_covariance_is_carried_over_the_lever():
    """Against numerical derivatives: errors turn and shift the camera in the world."""
    motion = base_motion(live_pose(POSE), LEVER)
    columns, small = [], 1e-6
    for error in small * np.eye(6):
        moved = geometry.make_transform(geometry.exp_so3(error[3:]) @ POSE[:3, :3],
                                        POSE[:3, 3] + error[:3])
        base = base_pose(moved, LEVER)
        turn = base[:3, :3] @ motion.T_odom_base[:3, :3].T
        columns.append(np.append(base[:3, 3] - motion.T_odom_base[:3, 3],
                                 geometry.log_so3(turn)) / small)
    jacobian = np.array(columns).T
    np.testing.assert_allclose(motion.covariance, jacobian @ covariance(1) @ jacobian.T,
                               rtol=1e-4, atol=1e-8)


def test_twist_is_the_finite_difference_in_the_frame_of_the_base():
    before, now = base_pose(POSE, LEVER), base_pose(POSE @ MOTION, LEVER)
    motion = base_motion(live_pose(POSE @ MOTION, MOTION), LEVER)
    seconds = INTERVAL_NS / NANOSECONDS
    linear = now[:3, :3].T @ (now[:3, 3] - before[:3, 3]) / seconds
    angular = geometry.log_so3(before[:3, :3].T @ now[:3, :3]) / seconds
    np.testing.assert_allclose(motion.twist, np.append(linear, angular), atol=1e-9)
    plain = base_motion(live_pose(POSE @ MOTION, MOTION), T_BODY_OPTICAL)  # no lever
    np.testing.assert_allclose(np.linalg.eigvalsh(plain.twist_covariance),
                               np.linalg.eigvalsh(covariance(2)) / seconds ** 2)


def test_covariance_of_the_twist_is_carried_over_the_lever():
    """As that of the pose, but in the axes of the base; of slow motion, or terms are missing."""
    slow = geometry.make_transform(geometry.exp_so3(np.array([2e-5, 5e-5, -3e-5])),
                                   np.array([1e-5, 2e-5, 3e-5]))
    motion = base_motion(live_pose(POSE @ slow, slow), LEVER)
    columns, small = [], 1e-6
    for error in small * np.eye(6):
        now = POSE @ slow
        moved = geometry.make_transform(geometry.exp_so3(error[3:]) @ now[:3, :3],
                                        now[:3, 3] + error[:3])
        change = geometry.relative(POSE, moved)
        columns.append((base_motion(live_pose(moved, change), LEVER).twist - motion.twist) / small)
    jacobian = np.array(columns).T
    expected = jacobian @ covariance(2) @ jacobian.T
    np.testing.assert_allclose(motion.twist_covariance, expected,
                               atol=1e-3 * np.abs(expected).max())


def test_of_the_first_velocity_nothing_is_known():
    motion = base_motion(live_pose(POSE), LEVER)
    assert not motion.twist.any()
    assert (motion.twist_covariance == UNKNOWN_VARIANCE * np.eye(6)).all()
