# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth as messages in time order."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from kfvo_ros.recording.messages import header_of, odometry_message, point_message
from kfvo_ros.sequences.base import GroundTruth

ODOMETRY_TOPIC = '/ground_truth/odometry'
POINT_TOPIC = '/ground_truth/position'
WORLD = 'world'
"""The frame in which ground truth is given."""


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
