# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera is on the robot, and TF, where there is one."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.time import Time

from kfvo_ros.errors import KfvoError
from kfvo_ros.odometry.base_motion import T_BODY_OPTICAL
from kfvo_ros.odometry.factory import parse_transform
from kfvo_ros.ros.messages import to_transform
from kfvo_ros.ros.options import NodeOptions

try:
    import tf2_ros
except ImportError:  # the wheels of ROS for pip have none
    tf2_ros = None
NO_TF = 'tf2_ros is not installed (apt install ros-jazzy-tf2-ros-py)'


class BaseFrame:
    """T_base_camera: a turn of the axes, the parameter's, or TF's. Raises KfvoError."""

    def __init__(self, node: Node, options: NodeOptions) -> None:
        self._frame = options.base_frame
        self._T_base_camera = parse_transform(options.base_to_camera or None)
        self._buffer: Any = None
        if not self._frame:
            if self._T_base_camera is not None:
                raise KfvoError('parameter base_to_camera needs the name of the base: set '
                                'base_frame')
            self._T_base_camera = T_BODY_OPTICAL
        elif self._T_base_camera is None:
            if tf2_ros is None:
                raise KfvoError(f'base_frame {self._frame} needs TF, and {NO_TF}: set '
                                'base_to_camera to "x y z qx qy qz qw"')
            self._buffer = tf2_ros.Buffer()
            self._listener = tf2_ros.TransformListener(self._buffer, node)

    def name(self, camera_frame: str) -> str:
        """Return the frame whose pose is published."""
        return self._frame or f'{camera_frame}_body'

    def transform(self, camera_frame: str) -> np.ndarray | None:
        """Return T_base_camera (4, 4), None while nobody knows it."""
        if self._T_base_camera is None:
            try:
                message = self._buffer.lookup_transform(self._frame, camera_frame, Time())
            except tf2_ros.TransformException:
                return None
            self._T_base_camera = to_transform(message)
        return self._T_base_camera

    def problem(self, camera_frame: str) -> str:
        """Return why nothing is published, and both remedies."""
        return (f'no transform from {self._frame} to {camera_frame}: publish it on TF, or set '
                'base_to_camera to "x y z qx qy qz qw"')


class TransformSender:
    """Sends transforms where tf2_ros is there; says once that it is not."""

    def __init__(self, node: Node, wanted: bool) -> None:
        self._broadcaster = None
        if wanted and tf2_ros is None:
            node.get_logger().warning(f'publish_tf is set, but {NO_TF}: no TF is sent')
        elif wanted:
            self._broadcaster = tf2_ros.TransformBroadcaster(node)

    def send(self, transform: TransformStamped) -> None:
        """Send one transform."""
        if self._broadcaster is not None:
            self._broadcaster.sendTransform(transform)
