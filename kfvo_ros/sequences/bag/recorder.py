# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A sequence as a robot would have recorded it: images, CameraInfo, ground truth, /tf_static."""

from __future__ import annotations

import re
from typing import Any

from kfvo_ros.camera import write_camera_info
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.camera import camera_info_topic, is_rectified
from kfvo_ros.sequences.bag.messages import (
    TruthMessages,
    camera_info_message,
    compressed_message,
    image_message,
    static_transforms_message,
)
from kfvo_ros.sequences.bag.writer import LATCHED, BagWriter
from kfvo_ros.sequences.base import CALIBRATION_FILE, Frame, Sequence
from kfvo_ros.trajectory import ASSOCIATION_LIMIT_NS

STATIC_TOPIC = '/tf_static'
_TOPIC = re.compile(r'(?!.*__)(/[A-Za-z_][A-Za-z0-9_]*)+')


class Recorder:
    """Writes the frames of a sequence and, in time order between them, its ground truth.

    Images go to `topic`, by default the sequence's own, with ``/compressed`` behind it when a
    `codec` compresses them. CameraInfo goes beside them, unless ``camera`` is None: nobody knows
    it, or it was guessed, and a guess must not be taken for a calibration. Raises KfvoError for
    topics that cannot be.
    """

    def __init__(self, sequence: Sequence, writer: BagWriter, topic: str | None = None,
                 codec: str | None = None) -> None:
        guessed = sequence.camera is None or sequence.camera.guessed
        self.camera = None if guessed else sequence.camera
        self.frame_count = 0
        self._writer, self._codec = writer, codec
        self._camera_frame = sequence.camera_frame
        self._transforms = sequence.extrinsics()
        truth = sequence.ground_truth()
        self._truth = None if truth is None else TruthMessages(truth, self._camera_frame)
        base = _valid_topic(topic or sequence.topic)
        self._image_topic = f'{base}/compressed' if codec else base
        self._info_topic = camera_info_topic(base)
        self._refuse_what_misleads(base)
        self._last_ns = 0

    def write(self, frame: Frame) -> None:
        """Append a frame, and the ground truth before it."""
        stamp_ns = frame.stamp_ns
        image = self._image_message(frame)  # it may be impossible, so before all that is written
        if self.frame_count == 0 and self._transforms:
            start_ns = stamp_ns if self._truth is None else self._truth.first_ns(stamp_ns)
            self._writer.write(STATIC_TOPIC, start_ns,
                               static_transforms_message(start_ns, self._transforms), LATCHED)
        self._write_truth(stamp_ns)
        if self.camera is not None:
            info = camera_info_message(stamp_ns, self._camera_frame, self.camera)
            self._writer.write(self._info_topic, stamp_ns, info)
        self._writer.write(self._image_topic, stamp_ns, image)
        self.frame_count += 1
        self._last_ns = stamp_ns

    def finish(self, complete: bool) -> None:
        """Close the bag, with all ground truth if `complete`, else with the last frame's."""
        self._write_truth(None if complete else self._last_ns + ASSOCIATION_LIMIT_NS)
        self._writer.close()
        if self.camera is not None and self.camera.readout_s > 0.0:
            # CameraInfo has no field for it; the file beside a bag's images is read with them.
            write_camera_info(self._writer.path / CALIBRATION_FILE, self.camera)

    def _image_message(self, frame: Frame) -> Any:
        if self._codec is None:
            return image_message(frame.stamp_ns, self._camera_frame, frame.image)
        return compressed_message(frame.stamp_ns, self._camera_frame, frame.image, self._codec)

    def _write_truth(self, end_ns: int | None) -> None:
        if self._truth is not None:
            for stamp_ns, message in self._truth.until(end_ns):
                self._writer.write(self._truth.topic, stamp_ns, message)

    def _refuse_what_misleads(self, base: str) -> None:
        """Raise KfvoError for a topic that is taken, or that promises what its images are not."""
        others = {self._info_topic, STATIC_TOPIC} | ({self._truth.topic} if self._truth else set())
        if self._image_topic in others:
            raise KfvoError(f'{base} is not for images in this recording; choose another --topic')
        if self.camera is not None and self.camera.distortion and is_rectified(base):
            raise KfvoError(f'{base} promises rectified images, but this camera distorts; choose '
                            'a --topic without "rect"')


def _valid_topic(name: str) -> str:
    """Return a topic's absolute name without /compressed; KfvoError where ROS 2 refuses it."""
    topic = f'/{name.lstrip("/")}'.removesuffix('/compressed')
    if not _TOPIC.fullmatch(topic):
        raise KfvoError(f'expected a --topic like /camera/image_raw, came {name!r}')
    return topic
