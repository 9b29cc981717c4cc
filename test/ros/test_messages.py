# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion between messages and arrays."""

from __future__ import annotations

import numpy as np
import pytest
from ros_processes import rclpy  # noqa: F401  (sets ROS_PYTHON_CHECK_FIELDS before the messages)

from kfvo_ros import geometry
from kfvo_ros.ros import messages
from kfvo_ros.trajectory import NANOSECONDS

serialization = pytest.importorskip('rclpy.serialization')


def test_messages_keep_their_values_through_serialization():
    """A value of a wrong type does not survive serialization."""
    def serialized(message):
        return serialization.deserialize_message(serialization.serialize_message(message),
                                                 type(message))

    pose = geometry.make_transform(geometry.exp_so3(np.array([-0.7, 0.4, 1.9])),
                                   np.array([3.0, -2.0, 0.5]))
    covariances = np.random.default_rng(0).normal(size=(2, 6, 6))
    stamp_ns = 12 * NANOSECONDS + 345_678_901
    transform = serialized(messages.make_transform_message(stamp_ns, 'odom', 'base_link', pose))
    np.testing.assert_allclose(messages.to_transform(transform), pose, atol=1e-12)
    assert messages.to_stamp_ns(transform.header.stamp) == stamp_ns
    assert (transform.header.frame_id, transform.child_frame_id) == ('odom', 'base_link')
    odometry = serialized(messages.make_odometry_message(
        stamp_ns, 'odom', 'base_link', pose, covariances[0], np.arange(6), covariances[1]))
    twist = odometry.twist.twist
    assert [getattr(part, axis) for part in (twist.linear, twist.angular)
            for axis in 'xyz'] == list(range(6))
    np.testing.assert_array_equal(odometry.pose.covariance, covariances[0].ravel())
    np.testing.assert_array_equal(odometry.twist.covariance, covariances[1].ravel())
    path = serialized(messages.make_path_message('odom', [(1, pose), (stamp_ns, np.eye(4))]))
    assert path.header == path.poses[-1].header and path.header.frame_id == 'odom'
    assert messages.make_path_message('odom', []).poses == []
