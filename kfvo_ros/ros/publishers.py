# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node's outputs: Odometry per image, keyframe poses, a throttled Path, TF."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from kfvo_ros.odometry.base_motion import base_motion, base_pose
from kfvo_ros.odometry.online import OnlinePose
from kfvo_ros.ros.frames import BaseFrame, TransformSender, has_moved
from kfvo_ros.ros.messages import (
    make_odometry_message,
    make_path_message,
    make_pose_message,
    make_transform_message,
)
from kfvo_ros.ros.options import NodeOptions

LOG_PERIOD_S = 5.0
"""Least time between two log lines about a problem that concerns every image."""


class Publishers:
    """Publishes poses of the base; nothing before T_base_camera is known.

    T_base_camera is that of the segment's start. ``problem`` says so where TF has another by now.
    """

    def __init__(self, node: Node, options: NodeOptions) -> None:
        self._logger = node.get_logger()
        self._odom_frame = options.odom_frame
        self._base = BaseFrame(node, options)
        self._sender = TransformSender(node, options.publish_tf)
        self._odometry = node.create_publisher(Odometry, '~/odometry', 10)
        self._keyframe = node.create_publisher(PoseStamped, '~/keyframe', 10)
        # A viewer that starts later gets the last path at once.
        self._path = node.create_publisher(
            Path, '~/path', QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self._path_period_s = 1.0 / options.path_rate
        self._path_published_s = -self._path_period_s
        self._path_outdated = False
        self._T_base_camera: np.ndarray | None = None
        self._camera_frame = ''
        self._is_logged = False
        self.problem = ''

    def start_segment(self) -> None:
        """Forget T_base_camera: it is looked up again for the next pose."""
        self._T_base_camera, self.problem = None, ''

    def publish(self, pose: OnlinePose, camera_frame: str) -> str:
        """Send one frame's Odometry and transform, and its pose again if it is a keyframe.

        Return why it is not sent, empty where it is. Raises KfvoError for impossible frames.
        """
        self._path_outdated = True
        T_base_camera = self._base.transform(camera_frame)
        if camera_frame != self._camera_frame or self._T_base_camera is None:
            self._use(camera_frame, T_base_camera)
        if self._T_base_camera is None:
            return self._base.problem(camera_frame)
        child = self._base.name(camera_frame)
        if T_base_camera is not None and T_base_camera is not self._T_base_camera:
            self.problem = (
                f'{camera_frame} moves on {child}, so the poses of {child} are wrong: set '
                'base_frame to the frame that carries the camera, or reset after the movement'
            ) if has_moved(T_base_camera, self._T_base_camera) else ''
        motion = base_motion(pose, self._T_base_camera)
        if not motion.is_finite:
            return f'the pose of {child} is not finite'
        self._odometry.publish(make_odometry_message(
            motion.stamp_ns, self._odom_frame, child, motion.T_odom_base, motion.covariance,
            motion.twist, motion.twist_covariance))
        if pose.is_keyframe:
            self._keyframe.publish(make_pose_message(motion.stamp_ns, self._odom_frame,
                                                     motion.T_odom_base))
        self._sender.send(make_transform_message(motion.stamp_ns, self._odom_frame, child,
                                                 motion.T_odom_base))
        return ''

    def publish_path(self, path: Callable[[], list[tuple[int, np.ndarray]]]) -> None:
        """Send the camera's `path` as that of the base, if it is due and has subscribers."""
        now = time.monotonic()
        if self._T_base_camera is None or not self._path_outdated \
                or now - self._path_published_s < self._path_period_s \
                or self._path.get_subscription_count() == 0:
            return
        self._path_published_s, self._path_outdated = now, False
        T_base_camera = self._T_base_camera
        self._path.publish(make_path_message(self._odom_frame, (
            (stamp_ns, base_pose(pose, T_base_camera)) for stamp_ns, pose in path())))

    def _use(self, camera_frame: str, T_base_camera: np.ndarray | None) -> None:
        """Take the transform of this camera for the segment; log the frames once it is known."""
        is_new = camera_frame != self._camera_frame or not self._is_logged
        self._camera_frame, self._T_base_camera = camera_frame, T_base_camera
        self._is_logged = T_base_camera is not None
        if is_new and self._is_logged:
            self._logger.info(f'frames: {self._odom_frame} -> {self._base.name(camera_frame)}, '
                              f'images in {camera_frame}', throttle_duration_sec=LOG_PERIOD_S)
