# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth of a bag, from one topic or transform, at the camera where that is possible."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.reader import TRANSFORMS, Bag, message_stamp_ns
from kfvo_ros.sequences.bag.transforms import Edge, TransformTree, transform_edge
from kfvo_ros.sequences.base import GroundTruth
from kfvo_ros.trajectory import Trajectory

POINT = 'geometry_msgs/msg/PointStamped'
TRANSFORM = 'geometry_msgs/msg/TransformStamped'
# Type, in order of preference -> (child frame or '', position, orientation or None).
_POSES: dict[str, Callable[[Any], tuple[str, Any, Any]]] = {
    'nav_msgs/msg/Odometry':
        lambda m: (m.child_frame_id, m.pose.pose.position, m.pose.pose.orientation),
    'geometry_msgs/msg/PoseStamped': lambda m: ('', m.pose.position, m.pose.orientation),
    'geometry_msgs/msg/PoseWithCovarianceStamped':
        lambda m: ('', m.pose.pose.position, m.pose.pose.orientation),
    TRANSFORM: lambda m: (m.child_frame_id, m.transform.translation, m.transform.rotation),
    POINT: lambda m: ('', m.point, None),
}
_log = logging.getLogger(__name__)


def read_bag_ground_truth(bag: Bag, topic: str | None, T_body_camera: np.ndarray | None,
                          camera_frame: str) -> GroundTruth | None:
    """Return the measured trajectory of `topic`, else of the first topic by type and name.

    Poses become T_world_camera by `T_body_camera`, else by the bag's fixed transforms from the
    measured frame to `camera_frame`. Where neither exists, and for points, ``frame`` is the
    measured frame (the topic, where the messages name none). Returns None without ground truth;
    raises KfvoError where the requested `topic` has none.
    """
    chosen = _choose_topic(bag, topic)
    if chosen is None:
        return None
    tree = TransformTree(bag)
    is_transform = bag.topics[chosen] in TRANSFORMS
    edge = _choose_edge(tree, camera_frame) if is_transform else None
    if is_transform and edge is None:
        _check_not_requested(bag, topic, 'a moving transform')
        return None
    body, trajectory = _read_trajectory(bag, chosen, edge)
    if len(trajectory) == 0:
        _check_not_requested(bag, topic, 'a pose of finite numbers')
        return None
    _log.info('%s: the ground truth is %s of %s', bag.path, body or 'the pose', chosen)
    if T_body_camera is None and body:
        T_body_camera = tree.lookup(body, camera_frame)
    if T_body_camera is None or not trajectory.has_rotation:
        return GroundTruth(trajectory, body or chosen)
    return GroundTruth(trajectory.right_multiplied(T_body_camera))


def _check_not_requested(bag: Bag, topic: str | None, expected: str) -> None:
    """Raise KfvoError if the user requested the topic that has no ground truth."""
    if topic is not None:
        raise KfvoError(f'{bag.path}: expected {expected} on {topic}, found none; ask for '
                        'another ground truth topic')


def _choose_topic(bag: Bag, topic: str | None) -> str | None:
    """Return the requested topic, else the first by type preference and name, else None."""
    if topic is not None:
        return bag.find_topic(topic, frozenset(_POSES) | TRANSFORMS, 'poses, points or transforms')
    candidates = [name for kind in _POSES for name in bag.topics_of_type(kind)]
    candidates += [name for name in bag.topics_of_type(*TRANSFORMS)
                   if not name.endswith('/tf_static')]
    if len(candidates) > 1:
        _log.info('%s: %s is taken for the ground truth; other candidates: %s', bag.path,
                  candidates[0], ', '.join(candidates[1:]))
    return candidates[0] if candidates else None


def _choose_edge(tree: TransformTree, camera_frame: str) -> Edge | None:
    """Return the moving transform that carries the camera, else the first by name."""
    carrying = [edge for edge in tree.moving if tree.lookup(edge[1], camera_frame) is not None]
    candidates = carrying + [edge for edge in tree.moving if edge not in carrying]
    if len(candidates) > 1:
        _log.info('the transform %s -> %s is taken for the ground truth; others that move: %s',
                  *candidates[0], ', '.join(' -> '.join(edge) for edge in candidates[1:]))
    return candidates[0] if candidates else None


def _read_trajectory(bag: Bag, topic: str, edge: Edge | None) -> tuple[str, Trajectory]:
    """Return the measured frame ('' where unnamed) and its valid poses.

    Poses with NaN or a zero quaternion are left out: motion capture marks lost bodies so.
    """
    body, stamps_ns, rows = '', [], []
    for frame, stamp_ns, row in _measurements(bag, topic, edge):
        if np.isfinite(row).all() and any(row[3:]):
            body = frame
            stamps_ns.append(stamp_ns)
            rows.append(row)
    values = np.array(rows, dtype=np.float64).reshape(-1, 7)
    trajectory = Trajectory(np.array(stamps_ns, dtype=np.int64),
                            geometry.transform_from_xyz_quat(values),
                            has_rotation=bag.topics[topic] != POINT)
    return body, trajectory


def _measurements(bag: Bag, topic: str, edge: Edge | None
                  ) -> Iterator[tuple[str, int, list[float]]]:
    """Yield (measured frame, stamp_ns, [x y z qx qy qz qw]) of a topic or of one transform."""
    pose_of = _POSES[TRANSFORM if edge is not None else bag.topics[topic]]
    for bag_time_ns, message in bag.messages(topic):
        parts = [message] if edge is None else \
            [part for part in message.transforms if transform_edge(part) == edge]
        for part in parts:
            frame, position, orientation = pose_of(part)
            quat_xyzw = (0.0, 0.0, 0.0, 1.0) if orientation is None else \
                (orientation.x, orientation.y, orientation.z, orientation.w)
            yield (frame.lstrip('/'), message_stamp_ns(part.header, bag_time_ns),
                   [position.x, position.y, position.z, *quat_xyzw])
