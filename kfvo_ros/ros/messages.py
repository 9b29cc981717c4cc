# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion between ROS messages and arrays, and the wire format of message classes.

By default rclpy does not check field types: an int in a float field is sent as 5e-324, a numpy
float32 likewise, a two-dimensional covariance as garbage. All messages are made here, with each
field cast to its type.
"""

from __future__ import annotations

import importlib
import importlib.util
import pathlib
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry, Path
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from kfvo_ros import geometry
from kfvo_ros.images import decode_compressed, decode_image
from kfvo_ros.trajectory import NANOSECONDS

ROS2_TYPE_NAMES = {'tf/msg/tfMessage': 'tf2_msgs/msg/TFMessage'}
"""ROS 2 names of the ROS 1 types that were renamed."""
_TYPE_NAME = re.compile(r'([a-z]\w*)/msg/([A-Za-z]\w*)', re.ASCII)
_SEQUENCE = re.compile(r'sequence<(.+?)(?:, \d+)?>')
_ARRAY = re.compile(r'(.+)(\[\d+\])')
_BOUNDED_STRING = re.compile(r'(w?string)<\d+>')
_PRIMITIVES = {'boolean': 'bool', 'octet': 'byte', 'float': 'float32', 'double': 'float64'}


def to_array(message: Image | CompressedImage) -> np.ndarray:
    """Return the pixels, (H, W) or (H, W, 3) RGB uint8; raises KfvoError."""
    if isinstance(message, CompressedImage):
        return decode_compressed(message.data, message.format)
    return decode_image(message.encoding, message.height, message.width, message.step,
                        bool(message.is_bigendian), message.data)


def to_stamp_ns(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return stamp.sec * NANOSECONDS + stamp.nanosec


def make_header(stamp_ns: int, frame_id: str) -> Header:
    """Return a header of a stamp [ns] and a frame."""
    seconds, nanoseconds = divmod(int(stamp_ns), NANOSECONDS)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def make_odometry_message(stamp_ns: int, frame_id: str, child_frame_id: str,
                          T_frame_child: np.ndarray, covariance: np.ndarray, twist: np.ndarray,
                          twist_covariance: np.ndarray) -> Odometry:
    """Return an Odometry: pose in `frame_id`, `twist` (6,) in the child frame, linear first.

    Both covariances are (6, 6): translation first, then rotation.
    """
    message = Odometry(header=make_header(stamp_ns, frame_id), child_frame_id=child_frame_id)
    message.pose.pose = _pose(T_frame_child)
    message.pose.covariance = np.asarray(covariance, dtype=np.float64).ravel()
    message.twist.twist.linear = _vector(twist[:3])
    message.twist.twist.angular = _vector(twist[3:])
    message.twist.covariance = np.asarray(twist_covariance, dtype=np.float64).ravel()
    return message


def make_pose_message(stamp_ns: int, frame_id: str, T_frame_child: np.ndarray) -> PoseStamped:
    """Return a PoseStamped in `frame_id`."""
    return PoseStamped(header=make_header(stamp_ns, frame_id), pose=_pose(T_frame_child))


def make_path_message(frame_id: str, poses: Iterable[tuple[int, np.ndarray]]) -> Path:
    """Return a Path of (stamp_ns, T_frame_child) with the stamp of its last pose."""
    stamped = [make_pose_message(stamp_ns, frame_id, pose) for stamp_ns, pose in poses]
    header = Header(frame_id=frame_id)
    if stamped:
        header.stamp = stamped[-1].header.stamp
    return Path(header=header, poses=stamped)


def make_transform_message(stamp_ns: int, frame_id: str, child_frame_id: str,
                           T_frame_child: np.ndarray) -> TransformStamped:
    """Return T_frame_child as a message of TF."""
    message = TransformStamped(header=make_header(stamp_ns, frame_id),
                               child_frame_id=child_frame_id)
    message.transform.translation = _vector(T_frame_child[:3, 3])
    message.transform.rotation = _quaternion(T_frame_child)
    return message


def to_transform(message: TransformStamped) -> np.ndarray:
    """Return T_frame_child (4, 4) of a message of TF."""
    t, q = message.transform.translation, message.transform.rotation
    return geometry.transform_from_xyz_quat(np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w]))


def find_message_class(type_name: str) -> type[Any] | None:
    """Return the class of a type like ``sensor_msgs/msg/Image``, None if it is not installed."""
    found = _TYPE_NAME.fullmatch(ROS2_TYPE_NAMES.get(type_name, type_name))
    if found is None:
        return None
    package, name = found.groups()
    # The name comes from a bag: import nothing but packages of messages.
    spec = importlib.util.find_spec(package)
    folders = spec.submodule_search_locations if spec else None
    if not any(pathlib.Path(folder, 'msg', '__init__.py').is_file() for folder in folders or ()):
        return None
    return getattr(importlib.import_module(f'{package}.msg'), name, None)


def wire_format(message_class: Any) -> str:
    """Return the wire format of a class, in the notation of `Bag.wire_format`."""
    return ' '.join(map(_field_format, message_class.get_fields_and_field_types().values()))


def _field_format(field: str) -> str:
    """Return ``uint8[]`` for ``sequence<uint8>``, ``(int32 uint32)`` for a nested Time."""
    if found := _SEQUENCE.fullmatch(field):
        return f'{_field_format(found[1])}[]'
    if found := _ARRAY.fullmatch(field):
        return f'{_field_format(found[1])}{found[2]}'
    if found := _BOUNDED_STRING.fullmatch(field):
        return found[1]
    if '/' in field:
        nested = find_message_class(field.replace('/', '/msg/'))
        return f'({wire_format(nested) if nested else field})'
    return _PRIMITIVES.get(field, field)


def _pose(pose: np.ndarray) -> Pose:
    x, y, z = map(float, pose[:3, 3])
    return Pose(position=Point(x=x, y=y, z=z), orientation=_quaternion(pose))


def _vector(values: np.ndarray) -> Vector3:
    x, y, z = map(float, values)
    return Vector3(x=x, y=y, z=z)


def _quaternion(pose: np.ndarray) -> Quaternion:
    x, y, z, w = map(float, geometry.quat_xyzw_from_rotation(pose[:3, :3]))
    return Quaternion(x=x, y=y, z=z, w=w)
