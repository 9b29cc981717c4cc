# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A small tf2_ros for tests where there is none: it has no wheel, nor have its messages.

Listener and broadcaster use one topic of TransformStamped. `Buffer.lookup_transform` composes the
tree as tf2 does: it returns T_target_source, at time zero with the latest transform of each edge.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time

TOPIC = '/fake_tf'
QOS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
Rigid = tuple[np.ndarray, np.ndarray]
"""Quaternion (x, y, z, w) and translation."""
IDENTITY: Rigid = (np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))


class TransformException(Exception):  # noqa: N818
    """Base of all errors."""


class LookupException(TransformException):
    """A frame is unknown."""


class ConnectivityException(TransformException):
    """The frames are in two trees."""


class ExtrapolationException(TransformException):
    """No transform is recorded around the time."""


class Buffer:
    """The recorded tree: for each child frame its parent and transforms by stamp [ns]."""

    def __init__(self) -> None:
        self._edges: dict[str, tuple[str, dict[int, Rigid]]] = {}

    def set_transform(self, message: TransformStamped, authority: str) -> None:
        """Record one edge T_parent_child."""
        r, t = message.transform.rotation, message.transform.translation
        stamp_ns = Time.from_msg(message.header.stamp).nanoseconds
        _, history = self._edges.setdefault(message.child_frame_id, (message.header.frame_id, {}))
        history[stamp_ns] = (np.array([r.x, r.y, r.z, r.w]), np.array([t.x, t.y, t.z]))

    def lookup_transform(self, target_frame: str, source_frame: str, time: Time
                         ) -> TransformStamped:
        """Return T_target_source; raises TransformException."""
        edges = dict(self._edges)
        frames = {*edges, *(parent for parent, _ in edges.values())}
        if missing := {target_frame, source_frame} - frames:
            raise LookupException(f'unknown frames {missing}')
        target_root, T_root_target = _to_root(edges, target_frame, time.nanoseconds)
        source_root, T_root_source = _to_root(edges, source_frame, time.nanoseconds)
        if target_root != source_root:
            raise ConnectivityException(f'{target_frame} and {source_frame} are not connected')
        quaternion, translation = _compose(_inverse(T_root_target), T_root_source)
        message = TransformStamped(child_frame_id=source_frame)
        message.header.frame_id = target_frame
        for name, value in zip('xyzw', map(float, quaternion), strict=True):
            setattr(message.transform.rotation, name, value)
        for name, value in zip('xyz', map(float, translation), strict=True):
            setattr(message.transform.translation, name, value)
        return message

    def can_transform(self, target_frame: str, source_frame: str, time: Time) -> bool:
        """Return whether `lookup_transform` returns a transform."""
        try:
            self.lookup_transform(target_frame, source_frame, time)
            return True
        except TransformException:
            return False


class TransformListener:
    """Records transforms of the topic in a buffer."""

    def __init__(self, buffer: Buffer, node: Any) -> None:
        node.create_subscription(TransformStamped, TOPIC,
                                 lambda message: buffer.set_transform(message, 'topic'), QOS)


class TransformBroadcaster:
    """Sends transforms to the topic."""

    def __init__(self, node: Any) -> None:
        self._publisher = node.create_publisher(TransformStamped, TOPIC, QOS)

    def sendTransform(self, transform: TransformStamped) -> None:
        """Send one transform."""
        self._publisher.publish(transform)


def _to_root(edges: dict[str, tuple[str, dict[int, Rigid]]], frame: str, time_ns: int
             ) -> tuple[str, Rigid]:
    """Return the root of a frame's tree and T_root_frame."""
    T_root_frame = IDENTITY
    while frame in edges:
        frame, history = edges[frame]
        if time_ns and time_ns not in history:
            raise ExtrapolationException(f'no transform to {frame} at {time_ns} ns')
        T_root_frame = _compose(history[time_ns or max(history)], T_root_frame)
    return frame, T_root_frame


def _compose(first: Rigid, second: Rigid) -> Rigid:
    """Return T_a_c of T_a_b and T_b_c."""
    return (_product(first[0], second[0]), first[1] + _rotate(first[0], second[1]))


def _inverse(transform: Rigid) -> Rigid:
    conjugate = transform[0] * [-1.0, -1.0, -1.0, 1.0]
    return conjugate, -_rotate(conjugate, transform[1])


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the Hamilton product."""
    return np.append(p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3]),
                     p[3] * q[3] - p[:3] @ q[:3])


def _rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    inverse = quaternion * [-1.0, -1.0, -1.0, 1.0]
    return _product(_product(quaternion, np.append(vector, 0.0)), inverse)[:3]
