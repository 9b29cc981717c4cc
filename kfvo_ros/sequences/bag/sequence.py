# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags as sequences: ROS 1 .bag, ROS 2 folders with metadata.yaml, .mcap and .db3 files."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, printable
from kfvo_ros.images import decode_compressed, decode_image
from kfvo_ros.sequences.bag.camera import is_rectified, read_bag_camera
from kfvo_ros.sequences.bag.ground_truth import (
    find_ground_truth_topic,
    read_bag_ground_truth,
)
from kfvo_ros.sequences.bag.reader import COMPRESSED_IMAGE, Bag, message_stamp_ns
from kfvo_ros.sequences.bag.storage import (
    BAG_SUFFIXES,
    METADATA_FILE,
    WarnOnce,
    bag_kind,
    storage_files,
)
from kfvo_ros.sequences.bag.topics import choose_image_topic
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
from kfvo_ros.sequences.image_folder import list_images
from kfvo_ros.sequences.stamps import PERSISTENCE, OrderedImages
from kfvo_ros.trajectory import format_stamp

MAX_SEARCHED = 100
"""Number of messages at the start that are searched for an image."""
_log = logging.getLogger(__name__)


class BagSequence(Sequence):
    """The images of one topic of a bag, stamped by their headers and read one at a time.

    `length` counts messages, as the index states them. Images that are late, have an odd stamp
    or cannot be decoded are left out with a warning, so a defective recording has fewer frames.
    Raises KfvoError for a damaged bag, and one without images or with a broken calibration.
    """

    camera: Camera

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.name = printable(path.stem if path.suffix in BAG_SUFFIXES else path.name)
        self._path, self._warn = path, WarnOnce()
        self._ground_truth_topic: str | None = None
        self._sources: dict[str, str] = {}
        self._T_body_camera = None
        if settings.ground_truth_to_camera is not None:
            self._T_body_camera = geometry.as_rigid_transform(
                settings.ground_truth_to_camera, 'the ground truth to camera transform')
        self._left_out: Counter[str] = Counter()
        self._ordered: OrderedImages[Any] = OrderedImages()
        with Bag(path, self._warn) as bag:
            self.topic = choose_image_topic(bag, settings.image_topic)
            if settings.ground_truth_topic is not None:
                self._ground_truth_topic = find_ground_truth_topic(
                    bag, settings.ground_truth_topic)
            self._sources['image_topic'] = self.topic
            self._length = bag.count(self.topic)
            first, image = self._first_image(bag)
            self._frame_id = first.header.frame_id.lstrip('/')
            self.camera_frame = self._frame_id or self.camera_frame
            folder = path if path.is_dir() else path.parent
            calibration = Calibration(settings.camera, folder,
                                      partial(read_bag_camera, bag, self.topic),
                                      is_rectified(self.topic))
            self.camera = calibration.camera(self.name, image.shape[1], image.shape[0])

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; raises KfvoError for a damaged bag, or where the image size changes.

        One image of another size is left out, three in a row are a change.
        """
        self._left_out, self._ordered = Counter(), OrderedImages()
        other_size = 0
        with Bag(self._path, self._warn) as bag:
            for stamp_ns, message in self._ordered.select(self._messages(bag)):
                image = self._decode_or_leave_out(message)
                if image is None:
                    continue
                if image.shape[:2] == (self.camera.height, self.camera.width):
                    other_size = 0
                    yield Frame(stamp_ns, image, self.camera)
                    continue
                other_size += 1
                self._left_out['other_size'] += 1
                if other_size == PERSISTENCE:
                    raise KfvoError(
                        f'{self._path}, {self.topic} at {format_stamp(stamp_ns)} s: the image is '
                        f'{image.shape[1]}x{image.shape[0]}, those before it are '
                        f'{self.camera.width}x{self.camera.height}; a sequence has one size')
        self._report()

    @property
    def length(self) -> int:
        """Number of image messages."""
        return self._length

    @property
    def left_out(self) -> dict[str, int]:
        """Number of images left out so far, by the reason."""
        return dict(self._left_out + self._ordered.left_out)

    @property
    def sources(self) -> dict[str, str]:
        """Topics of the images and of the ground truth, the latter once it was read."""
        return dict(self._sources)

    def ground_truth(self) -> GroundTruth | None:
        """Read and return the measured trajectory, None where there is none."""
        with Bag(self._path, self._warn) as bag:
            topic, truth = read_bag_ground_truth(bag, self._ground_truth_topic,
                                                 self._T_body_camera, self._frame_id)
        if topic is not None:
            self._sources['ground_truth_topic'] = topic
        return truth

    def extrinsics(self) -> tuple[FixedTransform, ...]:
        """Return the user's transform, else the bag's fixed ones from the root to the camera."""
        if self._T_body_camera is not None:
            return (FixedTransform(BODY_FRAME, self.camera_frame, self._T_body_camera),)
        with Bag(self._path, self._warn) as bag:
            return tuple(reversed(TransformTree(bag).parents(self._frame_id)))

    def _messages(self, bag: Bag) -> Iterator[tuple[int, int, Any]]:
        """Yield (stamp_ns, bag time [ns], message) of the images; count those that are missing."""
        count = 0
        for bag_time_ns, message in bag.messages(self.topic):
            count += 1
            yield message_stamp_ns(message.header, 0), bag_time_ns, message
        if count < self._length:
            self._left_out['missing'] = self._length - count

    def _first_image(self, bag: Bag) -> tuple[Any, np.ndarray]:
        """Return the first message that can be decoded, and its pixels."""
        problem: KfvoError | None = None
        for _, message in islice(bag.messages(self.topic), MAX_SEARCHED):
            try:
                return message, self._decode(message)
            except KfvoError as error:
                problem = problem or error
        raise problem or bag.nothing_readable(self.topic)

    def _decode_or_leave_out(self, message: Any) -> np.ndarray | None:
        try:
            return self._decode(message)
        except KfvoError as error:
            if not self._left_out['unreadable']:
                _log.warning('%s; such images are left out', error)
            self._left_out['unreadable'] += 1
            return None

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

    def _report(self) -> None:
        """Log what was left out or replaced."""
        if left_out := self.left_out:
            kinds = ', '.join(f'{count} {kind.replace("_", " ")}'
                              for kind, count in left_out.items())
            _log.warning('%s: left out %d images on %s: %s', self.name, sum(left_out.values()),
                         self.topic, kinds)
        if self._ordered.by_arrival:
            _log.warning('%s: the stamps of %s are zero; bag times are used instead', self.name,
                         self.topic)
        if self._ordered.restarts:
            _log.warning('%s: the clock of %s goes back %d times; images up to its latest stamp '
                         'are late', self.name, self.topic, self._ordered.restarts)


def _matches(path: Path) -> bool:
    if path.is_dir():
        # A folder of images is one, even where a recording lies beside them.
        return (path / METADATA_FILE).is_file() or \
            (bool(storage_files(path)) and not list_images(path))
    return path.is_file() and bag_kind(path) is not None


KIND = SequenceKind('bag', 'a bag: .bag, .mcap, .db3 or a folder with metadata.yaml', _matches,
                    BagSequence)
