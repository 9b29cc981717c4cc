# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pose, twist and covariances of the robot base from those of its camera.

T_base_camera is fixed and odom is the base at the first image, as world is the camera there:
T_odom_base = T_base_camera T_world_camera T_base_camera^-1. The base has the axes of REP-103:
x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.odometry.online import OnlinePose
from kfvo_ros.trajectory import NANOSECONDS, UNKNOWN_VARIANCE

T_BODY_OPTICAL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0],
                           [0.0, 0.0, 0.0, 1.0]])
"""Rotation of an optical frame (x right, y down, z forward) in body axes (REP-103)."""


@dataclass(frozen=True)
class BaseMotion:
    """Pose and velocity of the base at ``stamp_ns``, the content of an Odometry message.

    ``T_odom_base`` (4, 4) with ``covariance`` (6, 6) in the axes of odom, translation first;
    ``twist`` (6,) linear [m/s], then angular [rad/s] in the axes of the base, with
    ``twist_covariance`` (6, 6).
    """

    stamp_ns: int
    T_odom_base: np.ndarray
    covariance: np.ndarray
    twist: np.ndarray
    twist_covariance: np.ndarray

    @property
    def is_finite(self) -> bool:
        """Whether no number is NaN or infinite."""
        return all(np.isfinite(values).all() for values in (
            self.T_odom_base, self.covariance, self.twist, self.twist_covariance))


def base_pose(T_world_camera: np.ndarray, T_base_camera: np.ndarray) -> np.ndarray:
    """Return T_odom_base (4, 4) for a camera pose T_world_camera (4, 4)."""
    return T_base_camera @ T_world_camera @ geometry.invert(T_base_camera)


def base_motion(pose: OnlinePose, T_base_camera: np.ndarray) -> BaseMotion:
    """Return the motion of the base; without a camera motion its twist is zero and unknown."""
    T_odom_base = base_pose(pose.T_world_camera, T_base_camera)
    adjoint = _adjoint(T_base_camera, T_odom_base)
    covariance = adjoint @ pose.covariance @ adjoint.T
    twist, twist_covariance = np.zeros(6), UNKNOWN_VARIANCE * np.eye(6)
    if pose.T_previous_camera is not None:
        seconds = pose.interval_ns / NANOSECONDS
        T_previous_base = base_pose(pose.T_previous_camera, T_base_camera)
        R_previous_base = T_previous_base[:3, :3]
        twist = np.concatenate([R_previous_base.T @ T_previous_base[:3, 3],
                                geometry.log_so3(R_previous_base)]) / seconds
        jacobian = np.kron(np.eye(2), T_odom_base[:3, :3].T) @ adjoint / seconds
        twist_covariance = jacobian @ pose.motion_covariance @ jacobian.T
    return BaseMotion(pose.stamp_ns, T_odom_base, _symmetric(covariance), twist,
                      _symmetric(twist_covariance))


def _adjoint(T_base_camera: np.ndarray, T_odom_base: np.ndarray) -> np.ndarray:
    """Return the matrix (6, 6) from camera pose errors in world to base pose errors in odom.

    A rotation error of the camera displaces the base by the lever arm between them.
    """
    R_odom_world = T_base_camera[:3, :3]
    lever = -T_odom_base[:3, :3] @ T_base_camera[:3, 3]  # from the camera to the base, in odom
    matrix = np.kron(np.eye(2), R_odom_world)
    matrix[:3, 3:] = -geometry.skew(lever) @ R_odom_world
    return matrix


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)
