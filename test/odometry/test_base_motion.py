# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Base motion from camera motion: frames, axes, twists and covariances."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.odometry.base_motion import T_BODY_OPTICAL, UNKNOWN_VARIANCE, base_motion, base_pose
from kfvo_ros.odometry.online import OnlinePose
from kfvo_ros.trajectory import NANOSECONDS

T_BASE_CAMERA = geometry.make_transform(geometry.exp_so3(np.array([0.3, -1.2, 0.5])),
                                        np.array([0.4, -0.2, 1.1]))
POSE = geometry.make_transform(geometry.exp_so3(np.array([-0.7, 0.4, 1.9])),
                               np.array([3.0, -2.0, 0.5]))
MOTION = geometry.make_transform(geometry.exp_so3(np.array([0.02, 0.05, -0.03])),
                                 np.array([0.1, 0.02, 0.3]))
INTERVAL_NS = NANOSECONDS // 20


def covariance(seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6))
    return 1e-4 * (root @ root.T + np.eye(6))


def online_pose(pose: np.ndarray, motion: np.ndarray | None = None) -> OnlinePose:
    return OnlinePose(7, pose, covariance(1), Status.OK, True, motion,
                      0 if motion is None else INTERVAL_NS, covariance(2))


@pytest.mark.parametrize(('camera', 'base'), [
    ((0, 0, 1), (1, 0, 0)), ((1, 0, 0), (0, -1, 0)), ((0, 1, 0), (0, 0, -1))])
def test_axes_are_those_of_rep_103(camera, base):
    moved = geometry.make_transform(geometry.exp_so3(0.1 * np.array(camera)), np.array(camera))
    pose = base_pose(moved, T_BODY_OPTICAL)
    np.testing.assert_allclose(pose[:3, 3], base, atol=1e-12)
    np.testing.assert_allclose(geometry.log_so3(pose[:3, :3]), 0.1 * np.array(base), atol=1e-12)


def test_rotation_about_the_base_does_not_translate_the_base():
    rotation = geometry.make_transform(geometry.exp_so3(np.array([0.0, 0.0, 0.8])), np.zeros(3))
    T_world_camera = geometry.invert(T_BASE_CAMERA) @ rotation @ T_BASE_CAMERA
    assert np.linalg.norm(T_world_camera[:3, 3]) > 0.1
    np.testing.assert_allclose(base_pose(T_world_camera, T_BASE_CAMERA), rotation, atol=1e-12)


def test_pose_covariance_against_numerical_derivatives():
    """A pose error of the camera rotates and translates it in the axes of the world."""
    motion = base_motion(online_pose(POSE), T_BASE_CAMERA)
    columns, step = [], 1e-6
    for error in step * np.eye(6):
        moved = geometry.make_transform(geometry.exp_so3(error[3:]) @ POSE[:3, :3],
                                        POSE[:3, 3] + error[:3])
        base = base_pose(moved, T_BASE_CAMERA)
        rotation = base[:3, :3] @ motion.T_odom_base[:3, :3].T
        columns.append(np.append(base[:3, 3] - motion.T_odom_base[:3, 3],
                                 geometry.log_so3(rotation)) / step)
    jacobian = np.array(columns).T
    np.testing.assert_allclose(motion.covariance, jacobian @ covariance(1) @ jacobian.T,
                               rtol=1e-4, atol=1e-8)


def test_yaw_error_displaces_a_base_behind_the_camera_to_the_right():
    """The camera is 2 m ahead of the base and yaws about its own centre by a deviation of 0.1."""
    T_base_camera = T_BODY_OPTICAL.copy()
    T_base_camera[0, 3] = 2.0
    yaw = np.zeros((6, 6))
    yaw[4, 4] = 0.1 ** 2  # about the camera's y, which points down
    pose = OnlinePose(7, np.eye(4), yaw, Status.OK, True, np.eye(4), NANOSECONDS, yaw)
    motion = base_motion(pose, T_base_camera)
    expected = np.zeros((6, 6))
    expected[1, 1], expected[5, 5] = 0.2 ** 2, 0.1 ** 2
    expected[1, 5] = expected[5, 1] = -0.2 * 0.1
    np.testing.assert_allclose(motion.covariance, expected, atol=1e-12)
    np.testing.assert_allclose(motion.twist_covariance, expected, atol=1e-12)


def test_twist_is_the_finite_difference_in_the_base_frame():
    previous, current = base_pose(POSE, T_BASE_CAMERA), base_pose(POSE @ MOTION, T_BASE_CAMERA)
    motion = base_motion(online_pose(POSE @ MOTION, MOTION), T_BASE_CAMERA)
    seconds = INTERVAL_NS / NANOSECONDS
    linear = current[:3, :3].T @ (current[:3, 3] - previous[:3, 3]) / seconds
    angular = geometry.log_so3(previous[:3, :3].T @ current[:3, :3]) / seconds
    np.testing.assert_allclose(motion.twist, np.append(linear, angular), atol=1e-9)
    plain = base_motion(online_pose(POSE @ MOTION, MOTION), T_BODY_OPTICAL)  # no lever arm
    np.testing.assert_allclose(np.linalg.eigvalsh(plain.twist_covariance),
                               np.linalg.eigvalsh(covariance(2)) / seconds ** 2)


def test_twist_covariance_against_numerical_derivatives():
    """In the axes of the base; at slow motion, since terms of the motion are neglected."""
    slow = geometry.make_transform(geometry.exp_so3(np.array([2e-5, 5e-5, -3e-5])),
                                   np.array([1e-5, 2e-5, 3e-5]))
    motion = base_motion(online_pose(POSE @ slow, slow), T_BASE_CAMERA)
    columns, step = [], 1e-6
    for error in step * np.eye(6):
        current = POSE @ slow
        moved = geometry.make_transform(geometry.exp_so3(error[3:]) @ current[:3, :3],
                                        current[:3, 3] + error[:3])
        change = geometry.relative(POSE, moved)
        twist = base_motion(online_pose(moved, change), T_BASE_CAMERA).twist
        columns.append((twist - motion.twist) / step)
    jacobian = np.array(columns).T
    expected = jacobian @ covariance(2) @ jacobian.T
    np.testing.assert_allclose(motion.twist_covariance, expected,
                               atol=1e-3 * np.abs(expected).max())


def test_first_twist_is_unknown():
    motion = base_motion(online_pose(POSE), T_BASE_CAMERA)
    assert not motion.twist.any()
    assert (motion.twist_covariance == UNKNOWN_VARIANCE * np.eye(6)).all()
