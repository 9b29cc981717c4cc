# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Datasets read back with their stamps, images, calibration and ground truth."""

from __future__ import annotations

import numpy as np
import pytest
from sequence_writers import (
    DATASETS,
    HEIGHT,
    LENGTH,
    WIDTH,
    make_image,
    make_poses,
    write_camera_info,
    write_dataset,
    write_image,
    write_kitti,
    write_text,
)

from kfvo_ros.camera import Camera
from kfvo_ros.sequences import open_sequence

PINHOLE = Camera(WIDTH, HEIGHT, 99.0, 99.0, 16.0, 12.0)

every_dataset = pytest.mark.parametrize('kind', DATASETS)


@pytest.mark.parametrize('colour', [False, True])
@every_dataset
def test_datasets_read_back(kind, colour, tmp_path):
    path, stamps_ns = write_dataset(kind, tmp_path, colour)
    sequence = open_sequence(str(path))
    for _ in range(2):
        frames = list(sequence)
        assert [frame.stamp_ns for frame in frames] == stamps_ns
        assert all(type(frame.stamp_ns) is int for frame in frames)
        for index, frame in enumerate(frames):
            np.testing.assert_array_equal(frame.image, make_image(index, colour))
            assert frame.camera == sequence.camera
    assert sequence.length == LENGTH
    truth = sequence.ground_truth()
    assert truth.frame == 'camera' and truth.trajectory.has_rotation
    assert truth.trajectory.stamps_ns.tolist() == stamps_ns
    np.testing.assert_allclose(truth.trajectory.poses, make_poses(LENGTH), atol=1e-12)


def test_names_and_cameras(tmp_path):
    expected = {
        'euroc': ('V1_01', Camera(WIDTH, HEIGHT, 30.0, 31.0, 16.5, 12.5, 'plumb_bob',
                                  (-0.28, 0.07, 0.0002, 1.8e-05))),
        'tum': ('rgbd_dataset_freiburg1_test', Camera(
            640, 480, 517.306408, 516.469215, 318.643040, 255.313989, 'plumb_bob',
            (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
            readout_s=0.030).scaled(WIDTH, HEIGHT)),
        'kitti': ('kitti/03', Camera(WIDTH, HEIGHT, 30.0, 30.0, 16.0, 12.0)),
        'tartanair': ('hospital/Easy/P000',
                      Camera(640, 480, 320.0, 320.0, 320.0, 240.0).scaled(WIDTH, HEIGHT))}
    for kind, (name, camera) in expected.items():
        sequence = open_sequence(str(write_dataset(kind, tmp_path)[0]))
        assert (sequence.name, sequence.camera) == (name, camera)


@pytest.mark.parametrize(('folder', 'fx'), [
    ('rgbd_dataset_freiburg1_xyz', 517.306408), ('rgbd_dataset_freiburg2_desk', 520.908620),
    ('rgbd_dataset_freiburg3_long_office', 535.4), ('fr2_xyz', 520.908620), ('fr12_xyz', None),
    ('freiburg4', None)])
def test_tum_cameras_by_name(folder, fx, tmp_path):
    write_image(tmp_path / folder / 'rgb' / '0.png', np.zeros((480, 640), np.uint8))
    write_text(tmp_path / folder / 'rgb.txt', '0.5 rgb/0.png')
    camera = open_sequence(str(tmp_path / folder)).camera
    assert camera.guessed if fx is None else camera.fx == fx


def test_euroc_opens_by_mav0(tmp_path, monkeypatch):
    path, stamps_ns = write_dataset('euroc', tmp_path)
    write_camera_info(path, 77.0)
    by_parent = open_sequence(str(path))
    monkeypatch.chdir(path / 'mav0')
    by_mav0 = open_sequence('.')
    assert by_mav0.name == by_parent.name == 'V1_01'
    assert by_mav0.camera == by_parent.camera
    assert [frame.stamp_ns for frame in by_mav0] == stamps_ns


def test_kitti_without_grey_images_uses_colour(tmp_path):
    """image_2 has its own P2 and an offset from camera 0, whose poses the file holds."""
    images = [make_image(index, colour=True) for index in range(LENGTH)]
    path, _ = write_kitti(tmp_path, images, make_poses(LENGTH), camera='image_2')
    sequence = open_sequence(str(path))
    assert sequence.camera == Camera(WIDTH, HEIGHT, 40.0, 40.0, 15.0, 11.0)
    np.testing.assert_allclose(sequence.ground_truth().trajectory.poses, make_poses(LENGTH),
                               atol=1e-12)
    write_kitti(tmp_path, [make_image(9)] * LENGTH, make_poses(LENGTH))
    assert open_sequence(str(path)).camera.fx == 30.0  # grey images are preferred


@every_dataset
def test_camera_precedence(kind, tmp_path, caplog):
    """The user's camera precedes camera_info.yaml, which precedes the dataset's own."""
    path, _ = write_dataset(kind, tmp_path)
    dataset_camera = open_sequence(str(path)).camera
    write_camera_info(path, 55.0)
    assert open_sequence(str(path)).camera.fx == 55.0 != dataset_camera.fx
    assert open_sequence(str(path), camera=PINHOLE).camera == PINHOLE
    assert not dataset_camera.guessed and not caplog.records


def test_no_ground_truth(tmp_path):
    truths = {'euroc': 'mav0/state_groundtruth_estimate0/data.csv', 'tum': 'groundtruth.txt',
              'kitti': '../../poses/03.txt', 'tartanair': 'pose_left.txt'}
    for kind, truth in truths.items():
        path, _ = write_dataset(kind, tmp_path)
        (path / truth).unlink()
        assert open_sequence(str(path), kind=kind).ground_truth() is None


def test_stamps_that_do_not_increase_are_dropped_with_one_warning(tmp_path, caplog):
    path, stamps_ns = write_dataset('tum', tmp_path)
    lines = (path / 'rgb.txt').read_text().splitlines()
    write_text(path / 'rgb.txt', *lines[:4], lines[3], lines[2], *lines[4:])
    sequence = open_sequence(str(path))
    assert [frame.stamp_ns for frame in sequence] == stamps_ns
    assert sequence.length == LENGTH
    warning, = caplog.records
    assert 'left out 2 images' in warning.message
