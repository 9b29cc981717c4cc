# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of arrays to ROS 2 messages, as the dataclasses of rosbags."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from rosbags.typesys.stores import ros2_jazzy as ros

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import FixedTransform
from kfvo_ros.trajectory import NANOSECONDS, UNKNOWN_VARIANCE, format_stamp

END_NS = 2 ** 31 * NANOSECONDS
"""End of ROS time: its seconds have 31 bits, so they end in 2038."""


def header_of(stamp_ns: int, frame_id: str) -> ros.std_msgs__msg__Header:
    """Return a std_msgs/Header; raises KfvoError for a stamp that ROS cannot represent."""
    if not 0 <= stamp_ns < END_NS:
        raise KfvoError('expected a time of 1970 to 2038, the only ones of ROS; came '
                        f'{format_stamp(stamp_ns)} s')
    seconds, nanoseconds = divmod(int(stamp_ns), NANOSECONDS)
    stamp = ros.builtin_interfaces__msg__Time(sec=seconds, nanosec=nanoseconds)
    return ros.std_msgs__msg__Header(stamp=stamp, frame_id=frame_id)


def image_message(stamp_ns: int, frame_id: str, image: np.ndarray) -> ros.sensor_msgs__msg__Image:
    """Return a sensor_msgs/Image: mono8 of (H, W) uint8, rgb8 of (H, W, 3)."""
    height, width = image.shape[:2]
    return ros.sensor_msgs__msg__Image(
        header_of(stamp_ns, frame_id), height=height, width=width, encoding=_encoding(image),
        is_bigendian=0, step=image[0].nbytes, data=np.ascontiguousarray(image).reshape(-1))


def compressed_message(stamp_ns: int, frame_id: str, image: np.ndarray, codec: str
                       ) -> ros.sensor_msgs__msg__CompressedImage:
    """Return a sensor_msgs/CompressedImage in image_transport's format; JPEG has quality 95.

    `codec` is one of `kfvo_ros.images.CODECS`. Raises KfvoError for an image that cannot be
    encoded.
    """
    is_grey = image.ndim == 2
    bgr = image if is_grey else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    try:
        encoded, data = cv2.imencode(f'.{codec}', bgr)
    except cv2.error:
        encoded = False
    if not encoded:
        raise KfvoError(f'OpenCV cannot compress an image of {image.shape[1]}x{image.shape[0]} '
                        f'to {codec}; write it raw')
    return ros.sensor_msgs__msg__CompressedImage(
        header_of(stamp_ns, frame_id), data=data.reshape(-1),
        format=f'{_encoding(image)}; {codec} compressed {"" if is_grey else "bgr8"}')


def camera_info_message(stamp_ns: int, frame_id: str, camera: Camera
                        ) -> ros.sensor_msgs__msg__CameraInfo:
    """Return a sensor_msgs/CameraInfo of a monocular camera: R = I, P = [K 0]."""
    model, coefficients = camera.ros_distortion
    region = ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, do_rectify=False)
    return ros.sensor_msgs__msg__CameraInfo(
        header_of(stamp_ns, frame_id), height=camera.height, width=camera.width,
        distortion_model=model, d=np.array(coefficients), k=camera.matrix.ravel(),
        r=np.eye(3).ravel(), p=camera.projection.ravel(), binning_x=0, binning_y=0, roi=region)


def odometry_message(stamp_ns: int, world_frame: str, child_frame: str,
                     T_world_child: np.ndarray) -> ros.nav_msgs__msg__Odometry:
    """Return a nav_msgs/Odometry of T_world_child (4, 4), whose velocity is unknown."""
    zero = ros.geometry_msgs__msg__Vector3(0.0, 0.0, 0.0)
    return ros.nav_msgs__msg__Odometry(
        header_of(stamp_ns, world_frame), child_frame_id=child_frame,
        pose=ros.geometry_msgs__msg__PoseWithCovariance(
            ros.geometry_msgs__msg__Pose(_point(T_world_child), _quaternion(T_world_child)),
            np.zeros(36)),
        twist=ros.geometry_msgs__msg__TwistWithCovariance(
            ros.geometry_msgs__msg__Twist(linear=zero, angular=zero),
            (UNKNOWN_VARIANCE * np.eye(6)).ravel()))


def point_message(stamp_ns: int, world_frame: str, T_world_point: np.ndarray
                  ) -> ros.geometry_msgs__msg__PointStamped:
    """Return a geometry_msgs/PointStamped of the position in T_world_point (4, 4)."""
    return ros.geometry_msgs__msg__PointStamped(header_of(stamp_ns, world_frame),
                                                _point(T_world_point))


def static_transforms_message(stamp_ns: int, transforms: Iterable[FixedTransform]
                              ) -> ros.tf2_msgs__msg__TFMessage:
    """Return a tf2_msgs/TFMessage of fixed transforms, all with one stamp."""
    return ros.tf2_msgs__msg__TFMessage([
        ros.geometry_msgs__msg__TransformStamped(
            header_of(stamp_ns, fixed.parent), child_frame_id=fixed.child,
            transform=ros.geometry_msgs__msg__Transform(
                ros.geometry_msgs__msg__Vector3(*map(float, fixed.T_parent_child[:3, 3])),
                _quaternion(fixed.T_parent_child)))
        for fixed in transforms])


def _encoding(image: np.ndarray) -> str:
    return 'mono8' if image.ndim == 2 else 'rgb8'


def _point(pose: np.ndarray) -> ros.geometry_msgs__msg__Point:
    return ros.geometry_msgs__msg__Point(*map(float, pose[:3, 3]))


def _quaternion(pose: np.ndarray) -> ros.geometry_msgs__msg__Quaternion:
    quat_xyzw = geometry.quat_xyzw_from_rotation(pose[:3, :3])
    return ros.geometry_msgs__msg__Quaternion(*map(float, quat_xyzw))
