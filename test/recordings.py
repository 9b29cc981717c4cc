# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small sequences of every kind, their recordings, and the comparison of the two."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from bag_writers import COUNT, POSES, START_NS, BagBuilder, images, truth_records
from rosbags.highlevel import AnyReader
from sequence_writers import (
    DATASETS,
    HEIGHT,
    T_BODY_CAMERA,
    WIDTH,
    make_image,
    write_camera_info,
    write_image,
)

from kfvo_ros.convert import main
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.base import Sequence


def write_bag(storage: str, root: Path, colour: bool) -> Path:
    """Write a bag with a calibrated camera on a mount on a measured body."""
    root.mkdir(parents=True, exist_ok=True)
    writer = BagBuilder(storage)
    mounts = writer.transforms(
        writer.transform(START_NS, T_BODY_CAMERA, 'mount', 'body'),
        writer.transform(START_NS, POSES[0], 'left_optical', 'mount'))
    info = writer.camera_info(33.0, distortion=(-0.2, 0.1, 0.0, 0.0, 0.01))
    return writer.write(root / 'walk', [
        ('/tf_static', START_NS, mounts), ('/left/camera_info', START_NS, info),
        *images(writer, '/left/image_raw', 'left_optical', colour),
        *truth_records(writer, '/vicon', writer.transform)])


def write_video(path: Path) -> Path:
    """Write a video without calibration."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 25.0, (WIDTH, HEIGHT))
    for index in range(COUNT):
        video.write(make_image(index, colour=True))
    video.release()
    return path


def write_sequence(kind: str, root: Path, colour: bool = False) -> str:
    """Write a small sequence of a kind and return its path, or its name if it is synthetic."""
    frames = [make_image(index, colour) for index in range(COUNT)]
    if kind in DATASETS:
        return str(DATASETS[kind](root, frames, POSES)[0])
    if kind == 'synthetic':
        return 'synthetic:7:smooth'
    if kind == 'video':
        return str(write_video(root / 'walk.avi'))
    if kind == 'folder':
        for index, image in enumerate(frames):
            write_image(root / 'walk' / f'{index}.png', image)
        write_camera_info(root / 'walk', 33.0)
        return str(root / 'walk')
    return str(write_bag(kind, root, colour))


def convert_and_open(source: str, bag: Path, *arguments: object) -> Sequence:
    """Convert in this process and open the recording."""
    assert main([source, str(bag), *map(str, arguments)]) == 0
    return open_sequence(str(bag))


def topics_of(bag: Path) -> dict[str, dict]:
    """Return the topics in metadata.yaml, by name."""
    information = yaml.safe_load((bag / 'metadata.yaml').read_text())[
        'rosbag2_bagfile_information']
    return {topic['topic_metadata']['name']: topic['topic_metadata'] | topic
            for topic in information['topics_with_message_count']}


def messages_of(bag: Path, topic: str) -> Iterator[tuple[int, Any]]:
    """Yield (bag time [ns], message) of a topic."""
    with AnyReader([bag]) as reader:
        for connection, bag_time_ns, raw in reader.messages():
            if connection.topic == topic:
                yield bag_time_ns, reader.deserialize(raw, connection.msgtype)


def assert_same_sequence(original: Sequence, copy: Sequence, count: int,
                         tolerance: float = 0.0) -> None:
    """Assert equal stamps, images, cameras, extrinsics and ground truth.

    `tolerance` is the RMS difference of the images.
    """
    frames = list(copy)
    assert copy.length == len(frames) == count
    assert copy.camera == original.camera and copy.camera_frame == original.camera_frame
    for index, (frame, expected) in enumerate(zip(frames, original)):
        assert frame.stamp_ns == expected.stamp_ns and frame.camera == original.camera
        assert frame.image.shape == expected.image.shape, index
        difference = frame.image.astype(float) - expected.image
        assert np.sqrt(np.mean(difference ** 2)) <= tolerance
    for fixed, expected in zip(copy.extrinsics(), original.extrinsics(), strict=True):
        assert (fixed.parent, fixed.child) == (expected.parent, expected.child)
        np.testing.assert_allclose(fixed.T_parent_child, expected.T_parent_child, atol=1e-12)
    truth, expected = copy.ground_truth(), original.ground_truth()
    assert (truth is None) == (expected is None)
    if expected is not None:
        assert truth.frame == expected.frame
        assert truth.trajectory.has_rotation == expected.trajectory.has_rotation
        size = len(truth.trajectory)
        np.testing.assert_array_equal(truth.trajectory.stamps_ns,
                                      expected.trajectory.stamps_ns[:size])
        np.testing.assert_allclose(truth.trajectory.poses, expected.trajectory.poses[:size],
                                   atol=1e-12)
        assert size == (count if 'synthetic' in original.name else len(expected.trajectory))
