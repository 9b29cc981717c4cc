# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The camera's place on the robot base, and TF where tf2_ros is installed."""

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
except ImportError:  # ROS wheels for pip do not include it
    tf2_ros = None
NO_TF = 'tf2_ros is not installed (apt install ros-jazzy-tf2-ros-py)'


class BaseFrame:
    """The robot base that is published, and T_base_camera.

    Without `base_frame` the base is the camera itself with the axes of REP-103. Else
    T_base_camera is the parameter `base_to_camera`, or comes from TF, where it is looked up
    until it is found and then kept. Raises KfvoError when the parameters contradict each other
    or TF is needed and not installed.
    """

    def __init__(self, node: Node, options: NodeOptions) -> None:
        self._base_frame = options.base_frame
        self._T_base_camera = parse_transform(options.base_to_camera or None)
        self._buffer: Any = None
        if not self._base_frame:
            if self._T_base_camera is not None:
                raise KfvoError('parameter base_to_camera needs the name of the base: set '
                                'base_frame')
            self._T_base_camera = T_BODY_OPTICAL
        elif self._T_base_camera is None:
            if tf2_ros is None:
                raise KfvoError(f'base_frame {self._base_frame} needs TF, and {NO_TF}: set '
                                'base_to_camera to "x y z qx qy qz qw"')
            self._buffer = tf2_ros.Buffer()
            self._listener = tf2_ros.TransformListener(self._buffer, node)

    def name(self, camera_frame: str) -> str:
        """Return the frame whose pose is published."""
        return self._base_frame or f'{camera_frame}_body'

    def transform(self, camera_frame: str) -> np.ndarray | None:
        """Return T_base_camera (4, 4), None while it is unknown."""
        if self._T_base_camera is None:
            try:
                # The latest: target base, source camera maps points of the camera into the base.
                message = self._buffer.lookup_transform(self._base_frame, camera_frame, Time())
            except tf2_ros.TransformException:
                return None
            self._T_base_camera = to_transform(message)
        return self._T_base_camera

    def problem(self, camera_frame: str) -> str:
        """Return why nothing is published, and both remedies."""
        return (f'no transform from {self._base_frame} to {camera_frame}: publish it on TF, or '
                'set base_to_camera to "x y z qx qy qz qw"')


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
