# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags as sequences: ROS 1 .bag, ROS 2 folders with metadata.yaml, .mcap and .db3 files."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.images import decode_compressed, decode_image
from kfvo_ros.sequences.bag.camera import read_bag_camera
from kfvo_ros.sequences.bag.ground_truth import read_bag_ground_truth
from kfvo_ros.sequences.bag.reader import (
    BAG_SUFFIXES,
    COMPRESSED_IMAGE,
    IMAGE,
    Bag,
    message_stamp_ns,
)
from kfvo_ros.sequences.bag.transforms import TransformTree
from kfvo_ros.sequences.base import (
    BODY_FRAME,
    Calibration,
    FixedTransform,
    Frame,
    GroundTruth,
    Sequence,
    SequenceKind,
    SequenceSettings,
)
from kfvo_ros.trajectory import format_stamp

IMAGE_TYPES = frozenset((IMAGE, COMPRESSED_IMAGE))
_log = logging.getLogger(__name__)


class BagSequence(Sequence):
    """The images of one topic of a bag, stamped by their headers and read one at a time.

    `length` counts messages. Images whose stamp does not increase are dropped with a warning, so
    a defective recording has fewer frames. Raises KfvoError for a damaged bag, a bag without
    images, and a first image or calibration that is broken.
    """

    camera: Camera

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.name = path.stem if path.suffix in BAG_SUFFIXES else path.name
        self._path = path
        self._ground_truth_topic = settings.ground_truth_topic
        self._T_body_camera = None
        if settings.ground_truth_to_camera is not None:
            self._T_body_camera = geometry.as_rigid_transform(
                settings.ground_truth_to_camera, 'the ground truth to camera transform')
        with Bag(path) as bag:
            self.topic = _choose_image_topic(bag, settings.image_topic)
            self._length = bag.count(self.topic)
            first = bag.first_message(self.topic)
            self._frame_id = first.header.frame_id.lstrip('/')
            self.camera_frame = self._frame_id or self.camera_frame
            height, width = self._decode(first).shape[:2]
            folder = path if path.is_dir() else path.parent
            calibration = Calibration(settings.camera, folder,
                                      partial(read_bag_camera, bag, self.topic))
            self.camera = calibration.camera(self.name, width, height)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; raises KfvoError for a damaged bag or an image it cannot decode."""
        last_ns, dropped = None, 0
        with Bag(self._path) as bag:
            for bag_time_ns, message in bag.messages(self.topic):
                stamp_ns = message_stamp_ns(message.header, bag_time_ns)
                if last_ns is not None and stamp_ns <= last_ns:
                    dropped += 1
                    continue
                last_ns = stamp_ns
                yield Frame(stamp_ns, self._decode_checked(stamp_ns, message), self.camera)
        if dropped:
            _log.warning('%s: left out %d images on %s whose stamps do not increase', self.name,
                         dropped, self.topic)

    @property
    def length(self) -> int:
        """Number of image messages."""
        return self._length

    def ground_truth(self) -> GroundTruth | None:
        """Read and return the measured trajectory, None where there is none."""
        with Bag(self._path) as bag:
            return read_bag_ground_truth(bag, self._ground_truth_topic, self._T_body_camera,
                                         self._frame_id)

    def extrinsics(self) -> tuple[FixedTransform, ...]:
        """Return the user's transform, else the bag's fixed ones from the root to the camera."""
        if self._T_body_camera is not None:
            return (FixedTransform(BODY_FRAME, self.camera_frame, self._T_body_camera),)
        with Bag(self._path) as bag:
            return tuple(reversed(TransformTree(bag).parents(self._frame_id)))

    def _decode(self, message: Any) -> np.ndarray:
        """Return the pixels of an Image or CompressedImage; raises KfvoError with the stamp."""
        try:
            if message.__msgtype__ == COMPRESSED_IMAGE:
                return decode_compressed(message.data, message.format)
            return decode_image(message.encoding, message.height, message.width, message.step,
                                bool(message.is_bigendian), message.data)
        except KfvoError as error:
            stamp = format_stamp(message_stamp_ns(message.header, 0))
            raise KfvoError(f'{self._path}, {self.topic} at {stamp} s: {error}') from error

    def _decode_checked(self, stamp_ns: int, message: Any) -> np.ndarray:
        """Return the pixels of a message; raises KfvoError for a size other than the camera's."""
        image, camera = self._decode(message), self.camera
        if image.shape[:2] != (camera.height, camera.width):
            raise KfvoError(f'{self._path}, {self.topic} at {format_stamp(stamp_ns)} s: the image '
                            f'is {image.shape[1]}x{image.shape[0]}, those before it are '
                            f'{camera.width}x{camera.height}; a sequence has one size')
        return image


def _matches(path: Path) -> bool:
    return (path.is_file() and path.suffix in BAG_SUFFIXES) or (path / 'metadata.yaml').is_file()


KIND = SequenceKind('bag', 'a bag: .bag, .mcap, .db3 or a folder with metadata.yaml', _matches,
                    BagSequence)


def _choose_image_topic(bag: Bag, topic: str | None) -> str:
    """Return the requested topic, else the first by name, depth images last."""
    if topic is not None:
        return bag.find_topic(topic, IMAGE_TYPES, 'images')
    candidates = bag.image_topics()
    if not candidates:
        raise KfvoError(f'{bag.path}: expected a topic of type {IMAGE} or {COMPRESSED_IMAGE}; its '
                        f'topics are: {", ".join(sorted(bag.topics)) or "none"}')
    if len(candidates) > 1:
        _log.info('%s: using the images of %s; others are: %s', bag.path, candidates[0],
                  ', '.join(candidates[1:]))
    return candidates[0]
