# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The camera's place on the robot base, and TF where tf2_ros is installed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.time import Time

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.odometry.base_motion import T_BODY_OPTICAL
from kfvo_ros.odometry.factory import parse_transform
from kfvo_ros.ros.messages import to_transform
from kfvo_ros.ros.options import NodeOptions
from kfvo_ros.trajectory import MAX_POSITION

try:
    import tf2_ros
except ImportError:  # ROS wheels for pip do not include it
    tf2_ros = None
MOUNT_SHIFT_M, MOUNT_TURN_RAD = 0.005, 0.01
"""Changes of T_base_camera above which the mount moves."""
NO_TF = 'tf2_ros is not installed (apt install ros-jazzy-tf2-ros-py)'


class BaseFrame:
    """The robot base that is published, and T_base_camera.

    Without `base_frame` the base is the camera itself with the axes of REP-103. Else
    T_base_camera is the parameter `base_to_camera`, or comes from TF. Raises KfvoError when the
    parameters contradict each other or TF is needed and not installed.
    """

    def __init__(self, node: Node, options: NodeOptions) -> None:
        self._odom_frame, self._base_frame = options.odom_frame, options.base_frame
        self._T_base_camera = parse_transform(options.base_to_camera or None)
        self._buffer: Any = None
        if not self._base_frame:
            if self._T_base_camera is not None:
                raise KfvoError('parameter base_to_camera needs the name of the base: set '
                                'base_frame')
            self._T_base_camera = T_BODY_OPTICAL
        elif self._T_base_camera is not None:
            if not _is_credible(self._T_base_camera):
                raise KfvoError(f'parameter base_to_camera: expected metres, came '
                                f'{options.base_to_camera!r}')
        else:
            if tf2_ros is None:
                raise KfvoError(f'base_frame {self._base_frame} needs TF, and {NO_TF}: set '
                                'base_to_camera to "x y z qx qy qz qw"')
            self._buffer = tf2_ros.Buffer()
            self._listener = tf2_ros.TransformListener(self._buffer, node)

    def name(self, camera_frame: str) -> str:
        """Return the frame whose pose is published."""
        return self._base_frame or f'{camera_frame}_body'

    def transform(self, camera_frame: str) -> np.ndarray | None:
        """Return T_base_camera (4, 4) of a camera, from TF the latest; None while it is unknown.

        Raises KfvoError where odom would be the base or the camera itself.
        """
        if self._odom_frame in (camera_frame, self.name(camera_frame)):
            raise KfvoError(f'the images are in {camera_frame} and poses in {self._odom_frame}: '
                            'expected two frames; set odom_frame or camera_frame')
        if self._buffer is None:
            return self._T_base_camera
        try:
            # The latest: target base, source camera maps points of the camera into the base.
            message = self._buffer.lookup_transform(self._base_frame, camera_frame, Time())
        except tf2_ros.TransformException:
            return None
        transform = to_transform(message)
        return transform if _is_credible(transform) else None

    def problem(self, camera_frame: str) -> str:
        """Return why nothing is published, and both remedies."""
        return (f'no transform from {self._base_frame} to {camera_frame}: publish it on TF, or '
                'set base_to_camera to "x y z qx qy qz qw"')


def check_frames(options: NodeOptions, warn: Callable[[str], object]) -> NodeOptions:
    """Return the options with frame names as TF has them, without a leading slash.

    `warn` is called with a line for each that is changed or doubtful. Raises KfvoError for names
    that are empty or equal where two frames are meant.
    """
    names = {}
    for parameter in ('odom_frame', 'base_frame', 'camera_frame'):
        given = getattr(options, parameter)
        name = names[parameter] = given.strip().lstrip('/')
        if not name and (given or parameter == 'odom_frame'):
            raise KfvoError(f'parameter {parameter}: expected the name of a frame, came {given!r}')
        if name != given:
            warn(f'parameter {parameter}: frames of TF have no leading slash: {given!r} is used '
                 f'as {name}')
    for parameter in ('base_frame', 'camera_frame'):
        if names[parameter] == names['odom_frame']:
            raise KfvoError(f'parameters odom_frame and {parameter}: expected two frames, both '
                            f'are {names["odom_frame"]}')
    if names['base_frame'] and names['base_frame'] == names['camera_frame']:
        warn(f'base_frame and camera_frame are both {names["base_frame"]}: poses have the axes of '
             'the optical frame, z forward; an empty base_frame gives x forward')
    return replace(options, **names)


def has_moved(T_base_camera: np.ndarray, T_base_camera_before: np.ndarray) -> bool:
    """Return whether a mount moved by more than calibrations on TF differ."""
    T_before_now = geometry.relative(T_base_camera_before, T_base_camera)
    return (float(np.linalg.norm(T_before_now[:3, 3])) > MOUNT_SHIFT_M
            or float(np.linalg.norm(geometry.log_so3(T_before_now[:3, :3]))) > MOUNT_TURN_RAD)


def _is_credible(transform: np.ndarray) -> bool:
    return bool((np.abs(transform) <= MAX_POSITION).all())  # NaN is not


class TransformSender:
    """Sends transforms on TF; logs one warning where tf2_ros is missing."""

    def __init__(self, node: Node, enabled: bool) -> None:
        self._broadcaster: Any = None
        if enabled and tf2_ros is None:
            node.get_logger().warning(f'publish_tf is set, but {NO_TF}: no TF is sent')
        elif enabled:
            self._broadcaster = tf2_ros.TransformBroadcaster(node)

    def send(self, transform: TransformStamped) -> None:
        """Send one transform."""
        if self._broadcaster is not None:
            self._broadcaster.sendTransform(transform)
