# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Folders of images, videos, and detection of the kind of a sequence."""

from __future__ import annotations

import logging
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from sequence_writers import (
    LENGTH,
    make_image,
    write_camera_info,
    write_dataset,
    write_image,
    write_text,
)

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import KINDS, open_sequence


def write_folder(folder: Path, names: list[str]) -> Path:
    for index, name in enumerate(names):
        write_image(folder / name, make_image(index))
    return folder


def test_folder_is_read_in_natural_order(tmp_path, caplog):
    path = write_folder(tmp_path / 'walk', ['f1.png', 'f2.png', 'f10.png', 'f11.bmp'])
    write_text(path / 'notes.txt', 'no image')
    write_text(path / '._f1.png', 'a resource fork of macOS')
    sequence = open_sequence(str(path), rate=30000 / 1001)
    frames = list(sequence)
    assert [frame.stamp_ns for frame in frames] == [0, 33366666, 66733333, 100100000]
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, make_image(index))
    assert (sequence.name, sequence.length, sequence.ground_truth()) == ('walk', 4, None)
    assert sequence.camera.guessed
    warning, = caplog.records
    assert warning.levelno == logging.WARNING
    assert 'guessing' in warning.message and 'camera_info.yaml' in warning.message
    write_camera_info(path, 55.0)
    assert open_sequence(str(path)).camera.fx == 55.0
    assert len(caplog.records) == 1


def test_stamps_at_a_rate_do_not_drift(tmp_path):
    path = write_folder(tmp_path, [f'{index}.png' for index in range(5)])
    assert [frame.stamp_ns for frame in open_sequence(str(path), rate=3)] == \
        [index * 10 ** 9 // 3 for index in range(5)]
    assert [frame.stamp_ns for frame in open_sequence(str(path), rate=0.8)] == \
        [index * 1_250_000_000 for index in range(5)]
    for rate in (0.0, -1.0, float('nan'), float('inf')):
        with pytest.raises(KfvoError, match='positive number of frames per second'):
            open_sequence(str(path), rate=rate)


def write_video(path: Path, count: int, rate: float) -> list[np.ndarray]:
    """Write frames of one colour each and return them (RGB)."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), rate, (64, 48))
    colours = np.random.default_rng(0).integers(30, 220, (count, 3), dtype=np.uint8)
    images = [np.broadcast_to(colour, (48, 64, 3)) for colour in colours]
    for image in images:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
    return images


def test_video(tmp_path):
    images = write_video(tmp_path / 'walk.avi', 6, 25.0)
    write_camera_info(tmp_path, 55.0, 64, 48)
    sequence = open_sequence(str(tmp_path / 'walk.avi'), rate=3.0)
    assert (sequence.name, sequence.length, sequence.camera.fx) == ('walk', 6, 55.0)
    for _ in range(2):
        frames = list(sequence)
        assert [frame.stamp_ns for frame in frames] == [40_000_000 * n for n in range(6)]
        for frame, image in zip(frames, images, strict=True):
            assert np.abs(frame.image.astype(int) - image).max() <= 6


def test_a_cut_video_is_a_warning(tmp_path, caplog):
    path = tmp_path / 'walk.avi'
    write_video(path, 6, 20.0)
    open_sequence(str(path))
    assert not [each for each in caplog.messages if 'shorter' in each]
    path.write_bytes(path.read_bytes()[:-40])
    open_sequence(str(path))
    assert [each for each in caplog.messages if 'walk.avi: the file is shorter' in each]


def test_broken_video(tmp_path):
    (tmp_path / 'broken.avi').write_bytes(b'RIFF, but no more')
    with pytest.raises(KfvoError, match=r'cannot open the video .*broken\.avi'):
        open_sequence(str(tmp_path / 'broken.avi'))


def test_synthetic():
    sequence = open_sequence('synthetic:3:smooth')
    assert sequence.name == 'synthetic:3:smooth'
    with pytest.raises(KfvoError, match='synthetic:SEED'):
        open_sequence('synthetic:three')


@pytest.mark.parametrize('name', ['missing', 'empty', 'notes.txt'])
def test_the_error_for_an_unknown_path_describes_each_kind(name, tmp_path):
    (tmp_path / 'empty').mkdir()
    write_text(tmp_path / 'notes.txt', 'no sequence')
    with pytest.raises(KfvoError) as caught:
        open_sequence(str(tmp_path / name))
    message = str(caught.value)
    assert ('does not exist' in message) == (name == 'missing')
    assert all(kind.description in message for kind in KINDS.values())
    assert 'synthetic:SEED' in message and '\n' not in message


def test_kind_can_be_forced(tmp_path):
    path, _ = write_dataset('kitti', tmp_path)
    sequence = open_sequence(str(path / 'image_0'), kind='folder')
    assert (sequence.name, sequence.length) == ('image_0', LENGTH)
    with pytest.raises(KfvoError, match=r'cannot read .*rgb\.txt'):
        open_sequence(str(path), kind='tum')
    with pytest.raises(KfvoError, match='unknown kind.*pgm.*euroc, tum'):
        open_sequence(str(path), kind='pgm')


def test_memory_does_not_grow_with_length(tmp_path):
    image = np.zeros((480, 640, 3), np.uint8)
    for index in range(50):
        write_image(tmp_path / f'{index}.png', image)
    sequence = open_sequence(str(tmp_path), camera=Camera(640, 480, 500, 500, 320, 240))

    def peak_images(keep: bool) -> float:
        tracemalloc.start()
        kept = [frame if keep else frame.stamp_ns for frame in sequence]
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak / image.nbytes if kept else 0.0

    assert peak_images(keep=True) > 50  # checks the measurement itself
    assert peak_images(keep=False) < 5
