# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recording of a sequence to a bag: images, CameraInfo, ground truth and /tf_static."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import numpy as np

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.camera import CAMERA_RECORD, camera_info_topic, is_rectified
from kfvo_ros.sequences.bag.messages import (
    END_NS,
    camera_info_message,
    compressed_message,
    image_message,
    odometry_message,
    point_message,
    static_transforms_message,
)
from kfvo_ros.sequences.bag.topics import is_legal_topic, legal_topic
from kfvo_ros.sequences.bag.writer import LATCHED, BagWriter
from kfvo_ros.sequences.base import (
    FixedTransform,
    Frame,
    GroundTruth,
    Sequence,
    read_ground_truth,
)
from kfvo_ros.trajectory import ASSOCIATION_LIMIT_NS

STATIC_TOPIC = '/tf_static'
ODOMETRY_TOPIC = '/ground_truth/odometry'
POINT_TOPIC = '/ground_truth/position'
WORLD_FRAME = 'world'
"""The frame of ground truth poses."""
_log = logging.getLogger(__name__)


class Recorder:
    """Writes the frames of a sequence and, in time order between them, its ground truth.

    Images go to `topic`, by default the sequence's own, with ``/compressed`` appended when a
    `codec` compresses them. CameraInfo goes beside them, except for an unknown or guessed
    camera: ``camera`` is then None, because a reader would take a guess for a calibration.
    Names that ROS 2 does not allow are changed with a warning. Ground truth that cannot be read
    is left out with a warning. Raises KfvoError for an invalid `topic` and conflicting ones.
    """

    def __init__(self, sequence: Sequence, writer: BagWriter, topic: str | None = None,
                 codec: str | None = None) -> None:
        guessed = sequence.camera is None or sequence.camera.guessed
        self.camera = None if guessed else sequence.camera
        self.frame_count = 0
        self._writer, self._codec = writer, codec
        self._camera_frame = sequence.camera_frame
        self._transforms = _read_extrinsics(sequence)
        self._ground_truth = _make_ground_truth(sequence)
        raw_topic = _raw_topic(topic) if topic else \
            _allowed(f'/{sequence.topic.strip("/")}').removesuffix('/compressed')
        self._image_topic = f'{raw_topic}/compressed' if codec else raw_topic
        self._info_topic = camera_info_topic(raw_topic)
        self._check_topic(raw_topic)
        self._last_ns = 0

    def write(self, frame: Frame) -> None:
        """Append a frame and the ground truth up to its stamp; raises KfvoError."""
        stamp_ns = frame.stamp_ns
        image = self._image_message(frame)  # first, because it may raise
        if self.frame_count == 0 and self._transforms:
            self._write_transforms(stamp_ns)
        self._write_ground_truth(stamp_ns)
        if self.camera is not None:
            info = camera_info_message(stamp_ns, self._camera_frame, self.camera)
            self._writer.write(self._info_topic, stamp_ns, info)
        self._writer.write(self._image_topic, stamp_ns, image)
        self.frame_count += 1
        self._last_ns = stamp_ns

    def finish(self, complete: bool) -> None:
        """Close the bag; unless `complete`, omit the ground truth after the last frame."""
        self._write_ground_truth(None if complete else self._last_ns + ASSOCIATION_LIMIT_NS)
        if self.camera is not None and self.camera.readout_s > 0.0:
            self._writer.add_metadata(CAMERA_RECORD, {  # CameraInfo cannot hold it
                'image_topic': self._image_topic, 'readout_s': repr(self.camera.readout_s)})
        self._writer.close()

    def _image_message(self, frame: Frame) -> Any:
        if self._codec is None:
            return image_message(frame.stamp_ns, self._camera_frame, frame.image)
        return compressed_message(frame.stamp_ns, self._camera_frame, frame.image, self._codec)

    def _write_transforms(self, first_ns: int) -> None:
        if self._ground_truth is not None:
            first_ns = self._ground_truth.earliest_ns(first_ns)
        self._writer.write(STATIC_TOPIC, first_ns,
                           static_transforms_message(first_ns, self._transforms), LATCHED)

    def _write_ground_truth(self, end_ns: int | None) -> None:
        if self._ground_truth is not None:
            for stamp_ns, message in self._ground_truth.until(end_ns):
                self._writer.write(self._ground_truth.topic, stamp_ns, message)

    def _check_topic(self, raw_topic: str) -> None:
        """Raise KfvoError for an image topic that is taken, or wrongly named rectified."""
        others = {self._info_topic, STATIC_TOPIC}
        if self._ground_truth is not None:
            others.add(self._ground_truth.topic)
        if self._image_topic in others:
            raise KfvoError(f'{raw_topic} is not for images in this recording; choose another '
                            '--topic')
        if self.camera is not None and self.camera.distortion and is_rectified(raw_topic):
            raise KfvoError(f'{raw_topic} promises rectified images, but this camera distorts; '
                            'choose a --topic without "rect"')


class GroundTruthMessages:
    """Ground truth as Odometry messages, or PointStamped where it has no rotations.

    At the camera, the child frame is `camera_frame`, so that a reader needs no transform. A
    measured frame that is identified by its topic keeps the topic, with an empty child frame.
    ``left_out`` counts the poses whose stamps ROS cannot represent.
    """

    def __init__(self, ground_truth: GroundTruth, camera_frame: str) -> None:
        stamps_ns = ground_truth.trajectory.stamps_ns
        order = np.argsort(stamps_ns, kind='stable')
        in_ros_time = (stamps_ns[order] >= 0) & (stamps_ns[order] < END_NS)
        self.left_out = int(len(order) - in_ros_time.sum())
        self._trajectory = ground_truth.trajectory.select(order[in_ros_time])
        self._next = 0
        is_topic = ground_truth.frame.startswith('/')
        default_topic = ODOMETRY_TOPIC if self._trajectory.has_rotation else POINT_TOPIC
        self.topic = _allowed(ground_truth.frame) if is_topic else default_topic
        frame = camera_frame if ground_truth.frame == 'camera' else ground_truth.frame
        self._child_frame = '' if is_topic else frame

    def earliest_ns(self, other_ns: int) -> int:
        """Return the earlier of the first stamp and another."""
        return min([other_ns, *self._trajectory.stamps_ns[:1].tolist()])

    def until(self, end_ns: int | None) -> Iterator[tuple[int, Any]]:
        """Yield the (stamp_ns, message) not yielded before, up to `end_ns`; all for None."""
        stamps_ns = self._trajectory.stamps_ns
        end = len(stamps_ns) if end_ns is None else np.searchsorted(stamps_ns, end_ns, 'right')
        for index in range(self._next, int(end)):
            self._next = index + 1
            yield int(stamps_ns[index]), self._message(index)

    def _message(self, index: int) -> Any:
        stamp_ns, pose = int(self._trajectory.stamps_ns[index]), self._trajectory.poses[index]
        if self._trajectory.has_rotation:
            return odometry_message(stamp_ns, WORLD_FRAME, self._child_frame, pose)
        return point_message(stamp_ns, WORLD_FRAME, pose)


def _make_ground_truth(sequence: Sequence) -> GroundTruthMessages | None:
    """Return the ground truth of a sequence; a problem with it is only logged."""
    ground_truth, _ = read_ground_truth(sequence)
    if ground_truth is None:
        return None
    messages = GroundTruthMessages(ground_truth, sequence.camera_frame)
    if messages.left_out:
        _log.warning('%s: left out %d of %d poses of the ground truth, which are not of the years '
                     '1970 to 2038, the only ones of ROS', sequence.name, messages.left_out,
                     len(ground_truth.trajectory))
    return messages


def _read_extrinsics(sequence: Sequence) -> tuple[FixedTransform, ...]:
    """Return the transforms from the body to the camera; a problem with them is only logged."""
    try:
        return sequence.extrinsics()
    except KfvoError as error:
        _log.warning('%s: no /tf_static: %s', sequence.name, error)
        return ()


def _raw_topic(name: str) -> str:
    """Return a requested topic without /compressed; KfvoError for a name invalid in ROS 2."""
    topic = f'/{name.lstrip("/")}'.removesuffix('/compressed')
    if not is_legal_topic(topic):
        raise KfvoError(f'expected a --topic like /camera/image_raw, came {name!r}')
    return topic


def _allowed(topic: str) -> str:
    """Return the name under which a topic of the source is written."""
    allowed = legal_topic(topic)
    if allowed != topic:
        _log.warning('ROS 2 does not allow the topic %s; it is written as %s', topic, allowed)
    return allowed
