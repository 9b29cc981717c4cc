# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth of a bag, from one topic or transform, at the camera where that is possible."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.reader import TRANSFORMS, Bag, message_stamp_ns
from kfvo_ros.sequences.bag.transforms import Edge, TransformTree, transform_edge
from kfvo_ros.sequences.base import GroundTruth
from kfvo_ros.trajectory import Trajectory, is_credible

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
TRUTH_NAMES = re.compile(r'truth|(?<![a-z])gt(?![a-z])|mocap|motion_?capture|vicon|optitrack|vrpn|'
                         r'qualisys|leica|laser_?tracker')
"""In the names of topics that a measuring system publishes."""
ODOMETRY_NAMES = re.compile(r'odom|wheel|encoder')
"""In the names of topics whose poses are integrated, so that they drift."""
_log = logging.getLogger(__name__)


def read_bag_ground_truth(bag: Bag, topic: str | None, T_body_camera: np.ndarray | None,
                          camera_frame: str) -> tuple[str | None, GroundTruth | None]:
    """Return topic and measured trajectory of `topic`, else of the best one that has poses.

    Poses become T_world_camera by `T_body_camera`, else by the bag's fixed transforms from the
    measured frame to `camera_frame`. Where neither exists, and for points, ``frame`` is the
    measured frame (the topic, where the messages name none). Both are None without ground truth;
    raises KfvoError where the requested `topic` has none.
    """
    candidates = [topic] if topic is not None else _candidates(bag)
    tree = TransformTree(bag)
    for index, chosen in enumerate(candidates):
        body, trajectory = _read_trajectory(bag, tree, chosen, camera_frame)
        if len(trajectory) == 0:
            continue
        if topic is None:
            _report_choice(bag, chosen, body, candidates[index + 1:])
        if T_body_camera is None and body:
            T_body_camera = tree.lookup(body, camera_frame)
        if T_body_camera is None or not trajectory.has_rotation:
            return chosen, GroundTruth(trajectory, body or chosen)
        return chosen, GroundTruth(trajectory.right_multiplied(T_body_camera))
    if topic is not None:
        expected = 'a moving transform' if bag.topics[topic] in TRANSFORMS else 'a credible pose'
        raise KfvoError(f'{bag.path}: expected {expected} on {topic}, found none; ask for '
                        'another ground truth topic')
    return None, None


def find_ground_truth_topic(bag: Bag, topic: str) -> str:
    """Return the name of a requested topic; KfvoError for one that can hold no ground truth."""
    return bag.find_topic(topic, frozenset(_POSES) | TRANSFORMS, 'poses, points or transforms')


def _candidates(bag: Bag) -> list[str]:
    """Return the topics that may hold ground truth, best first.

    Names that say so come first, odometry of wheels and then transforms last; among equals the
    type decides, then the name.
    """
    names = [name for kind in _POSES for name in bag.topics_of_type(kind)]
    names += [name for name in bag.topics_of_type(*TRANSFORMS)
              if not name.endswith('/tf_static')]
    return sorted(names, key=lambda name: (
        TRUTH_NAMES.search(name.lower()) is None, bag.topics[name] in TRANSFORMS,
        is_odometry(name)))


def _report_choice(bag: Bag, chosen: str, body: str, others: list[str]) -> None:
    """Log what is taken for the ground truth; a warning if by its name it drifts."""
    alternatives = f'; other candidates: {", ".join(others)}' if others else ''
    if is_odometry(chosen):
        _log.warning('%s: %s is taken for the ground truth, but its name says odometry, which '
                     'drifts%s (choose by --ground-truth-topic)', bag.path, chosen, alternatives)
    else:
        _log.info('%s: the ground truth is %s; %s is taken%s', bag.path, body or 'the pose',
                  chosen, alternatives)


def is_odometry(name: str) -> bool:
    """Return whether the name of a topic or frame says odometry and not ground truth."""
    name = name.lower()
    return ODOMETRY_NAMES.search(name) is not None and TRUTH_NAMES.search(name) is None


def _choose_edge(tree: TransformTree, camera_frame: str) -> Edge | None:
    """Return the moving transform that carries the camera, else the first by name."""
    def rank(edge: Edge) -> tuple[bool, bool]:
        return tree.lookup(edge[1], camera_frame) is None, is_odometry(edge[0])

    candidates = sorted(tree.moving, key=rank)
    if candidates:
        others = ', '.join(' -> '.join(edge) for edge in candidates[1:])
        level = logging.WARNING if is_odometry(candidates[0][0]) else logging.INFO
        _log.log(level, 'the transform %s -> %s is taken for the ground truth%s', *candidates[0],
                 f'; others that move: {others}' if others else '')
    return candidates[0] if candidates else None


def _read_trajectory(bag: Bag, tree: TransformTree, topic: str, camera_frame: str
                     ) -> tuple[str, Trajectory]:
    """Return the measured frame ('' where unnamed) and its valid poses, none if it never moves.

    Poses with NaN or a zero quaternion are left out with a warning: motion capture marks lost
    bodies so.
    """
    body, stamps_ns, rows, count = '', [], [], 0
    is_transform = bag.topics[topic] in TRANSFORMS
    edge = _choose_edge(tree, camera_frame) if is_transform else None
    measurements = () if is_transform and edge is None else _measurements(bag, topic, edge)
    for frame, stamp_ns, row in measurements:
        count += 1
        if is_credible(row):
            body = frame
            stamps_ns.append(stamp_ns)
            rows.append(row)
    if len(rows) < count:
        _log.warning('%s: left out %d of %d poses on %s, which are not finite, not credible or '
                     'have no rotation', bag.path, count - len(rows), count, topic)
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
