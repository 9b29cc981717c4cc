# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays to messages of ROS 2, in the dataclasses of rosbags."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import cv2
import numpy as np
from rosbags.typesys.stores import ros2_jazzy as ros

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import FixedTransform, GroundTruth
from kfvo_ros.trajectory import NANOSECONDS, UNKNOWN_VARIANCE, format_stamp

END_NS = 2 ** 31 * NANOSECONDS
"""The seconds of a ROS stamp have 31 bits: they end in 2038."""
ODOMETRY_TOPIC = '/ground_truth/odometry'
POINT_TOPIC = '/ground_truth/position'
WORLD = 'world'
"""The frame in which ground truth is given."""
CODECS = ('png', 'jpeg')
"""Compressions of images by the name that ROS gives them; the first loses nothing."""


def header_of(stamp_ns: int, frame_id: str) -> ros.std_msgs__msg__Header:
    """Return a std_msgs/Header; raises KfvoError for a time that ROS cannot express."""
    if not 0 <= stamp_ns < END_NS:
        raise KfvoError('expected a time of 1970 to 2038, the only ones of ROS; came '
                        f'{format_stamp(stamp_ns)} s')
    seconds, nanoseconds = divmod(int(stamp_ns), NANOSECONDS)
    stamp = ros.builtin_interfaces__msg__Time(sec=seconds, nanosec=nanoseconds)
    return ros.std_msgs__msg__Header(stamp=stamp, frame_id=frame_id)


def image_message(stamp_ns: int, frame_id: str, image: np.ndarray) -> ros.sensor_msgs__msg__Image:
    """Return a sensor_msgs/Image, mono8 of (H, W) uint8 or rgb8 of (H, W, 3)."""
    height, width = image.shape[:2]
    return ros.sensor_msgs__msg__Image(
        header_of(stamp_ns, frame_id), height=height, width=width, encoding=_encoding(image),
        is_bigendian=0, step=image[0].nbytes, data=np.ascontiguousarray(image).reshape(-1))


def compressed_message(stamp_ns: int, frame_id: str, image: np.ndarray, codec: str
                       ) -> ros.sensor_msgs__msg__CompressedImage:
    """Return a sensor_msgs/CompressedImage as image_transport writes it, JPEG of quality 95.

    Raises KfvoError for an image that one of the CODECS cannot hold.
    """
    is_grey = image.ndim == 2
    bgr = image if is_grey else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    try:
        done, data = cv2.imencode(f'.{codec}', bgr)
    except cv2.error:
        done = False
    if not done:
        raise KfvoError(f'OpenCV cannot compress an image of {image.shape[1]}x{image.shape[0]} '
                        f'to {codec}; write it raw')
    return ros.sensor_msgs__msg__CompressedImage(
        header_of(stamp_ns, frame_id), data=data.reshape(-1),
        format=f'{_encoding(image)}; {codec} compressed {"" if is_grey else "bgr8"}')


def camera_info_message(stamp_ns: int, frame_id: str, camera: Camera
                        ) -> ros.sensor_msgs__msg__CameraInfo:
    """Return a sensor_msgs/CameraInfo: one camera, whose P is its K."""
    model, coefficients = camera.ros_distortion
    region = ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, do_rectify=False)
    return ros.sensor_msgs__msg__CameraInfo(
        header_of(stamp_ns, frame_id), height=camera.height, width=camera.width,
        distortion_model=model, d=np.array(coefficients), k=camera.matrix.ravel(),
        r=np.eye(3).ravel(), p=camera.projection.ravel(), binning_x=0, binning_y=0, roi=region)


def odometry_message(stamp_ns: int, world: str, frame_id: str, pose: np.ndarray
                     ) -> ros.nav_msgs__msg__Odometry:
    """Return a nav_msgs/Odometry of T_world_frame (4, 4), whose velocity is unknown."""
    zero = ros.geometry_msgs__msg__Vector3(0.0, 0.0, 0.0)
    return ros.nav_msgs__msg__Odometry(
        header_of(stamp_ns, world), child_frame_id=frame_id,
        pose=ros.geometry_msgs__msg__PoseWithCovariance(
            ros.geometry_msgs__msg__Pose(_point(pose), _quaternion(pose)), np.zeros(36)),
        twist=ros.geometry_msgs__msg__TwistWithCovariance(
            ros.geometry_msgs__msg__Twist(linear=zero, angular=zero),
            (UNKNOWN_VARIANCE * np.eye(6)).ravel()))


def point_message(stamp_ns: int, world: str, pose: np.ndarray
                  ) -> ros.geometry_msgs__msg__PointStamped:
    """Return a geometry_msgs/PointStamped of the position in T_world_point (4, 4)."""
    return ros.geometry_msgs__msg__PointStamped(header_of(stamp_ns, world), _point(pose))


def static_transforms_message(stamp_ns: int, transforms: Iterable[FixedTransform]
                              ) -> ros.tf2_msgs__msg__TFMessage:
    """Return a tf2_msgs/TFMessage."""
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


class TruthMessages:
    """Hands out ground truth as Odometry, or as PointStamped where it has no rotations.

    Truth at the camera has `camera_frame` for its child frame, so that nothing needs to be
    moved to read it back. A measured frame that is only known by its topic keeps the topic.
    Raises KfvoError for times that ROS cannot express.
    """

    def __init__(self, truth: GroundTruth, camera_frame: str) -> None:
        order = np.argsort(truth.trajectory.stamps_ns, kind='stable')
        self._trajectory = truth.trajectory.select(order)
        self._given = 0
        is_topic = truth.frame.startswith('/')
        own_topic = ODOMETRY_TOPIC if self._trajectory.has_rotation else POINT_TOPIC
        self.topic = truth.frame if is_topic else own_topic
        frame = camera_frame if truth.frame == 'camera' else truth.frame
        self._frame = '' if is_topic else frame
        for extreme_ns in (*self._trajectory.stamps_ns[:1], *self._trajectory.stamps_ns[-1:]):
            header_of(int(extreme_ns), WORLD)

    def first_ns(self, other_ns: int) -> int:
        """Return the earlier of the first stamp and another."""
        return min([other_ns, *self._trajectory.stamps_ns[:1].tolist()])

    def until(self, end_ns: int | None) -> Iterator[tuple[int, Any]]:
        """Yield (stamp_ns, message) of what was not handed out yet, up to `end_ns`; None: all."""
        stamps_ns = self._trajectory.stamps_ns
        end = len(stamps_ns) if end_ns is None else np.searchsorted(stamps_ns, end_ns, 'right')
        for index in range(self._given, int(end)):
            self._given = index + 1
            yield int(stamps_ns[index]), self._message(index)

    def _message(self, index: int) -> Any:
        stamp_ns, pose = int(self._trajectory.stamps_ns[index]), self._trajectory.poses[index]
        if self._trajectory.has_rotation:
            return odometry_message(stamp_ns, WORLD, self._frame, pose)
        return point_message(stamp_ns, WORLD, pose)
