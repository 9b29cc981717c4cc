# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the camera to the robot's base: poses, velocities and covariances that ROS expects.

With T_base_camera fixed, T_odom_base = T_base_camera T_world_camera T_base_camera^-1: odom is
where the base was at the first image. A base has the axes of REP-103: x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.odometry.online import OnlinePose
from kfvo_ros.trajectory import NANOSECONDS, UNKNOWN_VARIANCE

T_BODY_OPTICAL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0],
                           [0.0, 0.0, 0.0, 1.0]])
"""An optical frame (x right, y down, z forward) on a body in its place (REP-103)."""


@dataclass(frozen=True)
class BaseMotion:
    """What an Odometry message says of the base at ``stamp_ns``.

    ``T_odom_base`` (4, 4) with ``covariance`` (6, 6) in the axes of odom; ``twist`` (6,) linear
    [m/s] then angular [rad/s] in those of the base, with ``twist_covariance`` (6, 6).
    """

    stamp_ns: int
    T_odom_base: np.ndarray
    covariance: np.ndarray
    twist: np.ndarray
    twist_covariance: np.ndarray


def base_pose(T_world_camera: np.ndarray, T_base_camera: np.ndarray) -> np.ndarray:
    """Return T_odom_base (4, 4)."""
    return T_base_camera @ T_world_camera @ geometry.invert(T_base_camera)


def base_motion(pose: OnlinePose, T_base_camera: np.ndarray) -> BaseMotion:
    """Return what `pose`, of the camera, means for the base that carries it."""
    T_odom_base = base_pose(pose.T_world_camera, T_base_camera)
    moved = _adjoint(T_base_camera, T_odom_base)
    covariance = moved @ pose.covariance @ moved.T
    twist, twist_covariance = np.zeros(6), UNKNOWN_VARIANCE * np.eye(6)
    if pose.T_before_camera is not None:
        seconds = pose.interval_ns / NANOSECONDS
        T_before_base = base_pose(pose.T_before_camera, T_base_camera)
        turn = T_before_base[:3, :3]
        twist = np.concatenate([turn.T @ T_before_base[:3, 3], geometry.log_so3(turn)]) / seconds
        into_base = np.kron(np.eye(2), T_odom_base[:3, :3].T) @ moved / seconds
        twist_covariance = into_base @ pose.motion_covariance @ into_base.T
    return BaseMotion(pose.stamp_ns, T_odom_base, _symmetric(covariance), twist,
                      _symmetric(twist_covariance))


def _adjoint(T_base_camera: np.ndarray, T_odom_base: np.ndarray) -> np.ndarray:
    """Return the matrix (6, 6) from errors of the camera in the world to those of base in odom.

    The base is off the camera: where the camera's rotation errs, the base is displaced.
    """
    R_odom_world = T_base_camera[:3, :3]
    lever = -T_odom_base[:3, :3] @ T_base_camera[:3, 3]  # from the camera to the base, in odom
    matrix = np.kron(np.eye(2), R_odom_world)
    matrix[:3, 3:] = -geometry.skew(lever) @ R_odom_world
    return matrix


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)
