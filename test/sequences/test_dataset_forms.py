# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Forms in which datasets are found: other editors, layouts, names, and what is no file."""

from __future__ import annotations

import os
import random
from pathlib import Path

import numpy as np
import pytest
from sequence_writers import (
    HEIGHT,
    LENGTH,
    T_BODY_CAMERA,
    WIDTH,
    make_image,
    make_poses,
    numbers,
    write_camera_info,
    write_dataset,
    write_image,
    write_kitti,
    write_tartanair,
    write_text,
)

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.calibration import read_calibration
from kfvo_ros.sequences.image_folder import list_images

TABLES = {'euroc': ('mav0/cam0/data.csv', 'mav0/cam0/sensor.yaml',
                    'mav0/state_groundtruth_estimate0/data.csv'),
          'tum': ('rgb.txt', 'groundtruth.txt'), 'tartanair': ('pose_left.txt',),
          'kitti': ('times.txt', 'calib.txt', '../../poses/03.txt')}


@pytest.mark.parametrize('kind', TABLES)
def test_text_of_editors_on_windows(kind, tmp_path):
    path, stamps_ns = write_dataset(kind, tmp_path)
    camera = open_sequence(str(path)).camera
    for name in TABLES[kind]:
        data = (path / name).read_bytes().replace(b'\r', b'').replace(b'\n', b'\r\n')
        (path / name).write_bytes(b'\xef\xbb\xbf' + data)
    sequence = open_sequence(str(path))
    assert [frame.stamp_ns for frame in sequence] == stamps_ns
    assert sequence.camera == camera
    np.testing.assert_allclose(sequence.ground_truth().trajectory.poses, make_poses(LENGTH),
                               atol=1e-12)


# EuRoC and TUM VI


def test_euroc_without_a_sensor_file(tmp_path):
    """The ground truth is that of the body, and named so."""
    path, stamps_ns = write_dataset('euroc', tmp_path)
    (path / 'mav0' / 'cam0' / 'sensor.yaml').unlink()
    camera = Camera(WIDTH, HEIGHT, 30.0, 31.0, 16.5, 12.5)
    sequence = open_sequence(str(path), camera=camera)
    assert [frame.stamp_ns for frame in sequence] == stamps_ns
    assert sequence.camera == camera and sequence.extrinsics() == ()
    truth = sequence.ground_truth()
    assert truth.frame == 'body'
    np.testing.assert_allclose(truth.trajectory.poses,
                               make_poses(LENGTH) @ geometry.invert(T_BODY_CAMERA), atol=1e-12)
    assert open_sequence(str(path)).camera.guessed


def test_tum_vi_has_its_ground_truth_in_mocap0(tmp_path):
    path, stamps_ns = write_dataset('euroc', tmp_path)
    (path / 'mav0' / 'state_groundtruth_estimate0').rename(path / 'mav0' / 'mocap0')
    truth = open_sequence(str(path)).ground_truth()
    assert truth.frame == 'camera' and truth.trajectory.stamps_ns.tolist() == stamps_ns


# KITTI


def write_plain_kitti(root: Path) -> Path:
    return write_kitti(root, [make_image(index) for index in range(LENGTH)],
                       make_poses(LENGTH))[0]


def test_other_lines_of_a_calibration_are_not_looked_at(tmp_path):
    path = write_plain_kitti(tmp_path)
    with (path / 'calib.txt').open('a') as file:
        file.write('R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: nothing yet\ncalib_time: 1-Jan\n')
    assert open_sequence(str(path)).camera == Camera(WIDTH, HEIGHT, 30.0, 30.0, 16.0, 12.0)


def test_semantic_kitti_has_its_poses_in_the_folder(tmp_path):
    path = write_plain_kitti(tmp_path)
    (tmp_path / 'poses' / '03.txt').rename(path / 'poses.txt')
    np.testing.assert_allclose(open_sequence(str(path)).ground_truth().trajectory.poses,
                               make_poses(LENGTH), atol=1e-12)


@pytest.mark.parametrize(('first', 'digits'), [(0, 10), (1100, 10), (1, 6)])
def test_kitti_names_of_raw_drives(first, digits, tmp_path):
    path = write_plain_kitti(tmp_path)
    for index in range(LENGTH):
        (path / 'image_0' / f'{index:06d}.png').rename(
            path / 'image_0' / f'_{index + first:0{digits}d}.png')
    for file in (path / 'image_0').iterdir():
        file.rename(file.with_name(file.name[1:]))
    images = [frame.image for frame in open_sequence(str(path))]
    np.testing.assert_array_equal(images, [make_image(index) for index in range(LENGTH)])


def test_a_missing_image_of_kitti_does_not_shift_the_others(tmp_path):
    path = write_plain_kitti(tmp_path)
    (path / 'image_0' / '000000.png').unlink()
    with pytest.raises(KfvoError, match=r'000000\.png'):
        open_sequence(str(path))


def write_raw_drive(root: Path) -> Path:
    """Write a raw drive whose rectified images are as large as the images of the tests."""
    path = root / '2011_09_26' / '2011_09_26_drive_0001_sync'
    for index in range(LENGTH):
        write_image(path / 'image_02' / 'data' / f'{index:010d}.png', make_image(index))
    write_text(path / 'image_02' / 'timestamps.txt', *(
        f'2011-09-26 13:02:25.{964389445 + index:09d}' for index in range(LENGTH)))
    write_text(path.parent / 'calib_cam_to_cam.txt', 'calib_time: 09-Jan-2012 13:57:47',
               'S_02: 4e1 3e1', 'K_02: 50 0 20 0 51 15 0 0 1', 'D_02: -0.3 0.2 0.001 0 -0.07',
               f'S_rect_02: {WIDTH} {HEIGHT}', 'P_rect_02: 30 0 16 2 0 30 12 0 0 0 1 0')
    return path


def test_a_raw_drive_of_kitti(tmp_path, caplog):
    path = write_raw_drive(tmp_path)
    (path / 'oxts').mkdir()
    sequence = open_sequence(str(path))
    assert sequence.name == 'kitti/2011_09_26_drive_0001_sync'
    assert sequence.camera == Camera(WIDTH, HEIGHT, 30.0, 30.0, 16.0, 12.0)
    assert [frame.stamp_ns for frame in sequence] == \
        [1317042145964389445 + index for index in range(LENGTH)]
    assert sequence.ground_truth() is None
    assert 'oxts are not read' in caplog.messages[0]


def test_unrectified_images_of_a_raw_drive_have_its_distortion(tmp_path):
    path = write_raw_drive(tmp_path)
    for index in range(LENGTH):
        write_image(path / 'image_02' / 'data' / f'{index:010d}.png', np.zeros((30, 40), np.uint8))
    assert open_sequence(str(path)).camera == Camera(40, 30, 50.0, 51.0, 20.0, 15.0, 'plumb_bob',
                                                     (-0.3, 0.2, 0.001, 0.0, -0.07))


# TartanAir V2


def test_tartanair_v2(tmp_path):
    path, stamps_ns = write_tartanair(tmp_path, [np.zeros((64, 64), np.uint8)] * LENGTH,
                                      make_poses(LENGTH))
    (path / 'image_left').rename(path / 'image_lcam_front')
    (path / 'pose_left.txt').rename(path / 'pose_lcam_front.txt')
    sequence = open_sequence(str(path))
    assert sequence.camera == Camera(640, 640, 320.0, 320.0, 320.0, 320.0).scaled(64, 64)
    assert [frame.stamp_ns for frame in sequence] == stamps_ns
    np.testing.assert_allclose(sequence.ground_truth().trajectory.poses, make_poses(LENGTH),
                               atol=1e-12)


# Names and calibrations of folders


@pytest.mark.parametrize('names', [
    [f'IMG_{second}{copy}.jpg' for second in (170431, 170432)
     for copy in ('', ' (1)', ' (2)', ' (10)')],
    ['a.png', 'a - Copy.png', 'a - Copy (2).png', 'b.png', 'b copy.png', 'b copy 2.png'],
    ['9.png', '10.jpg', '11.png'], ['f1.png', 'f2.PNG', 'f2a.png', 'f10.png'],
    ['1305031229.5.png', '1305031229.528748.png', '1305031229.53.png', '1305031230.png'],
    ['v1.2.png', 'v1.10.png'], ['x1y2.png', 'x1y10.png', 'x2y1.png']])
def test_images_are_in_the_order_of_their_numbers(names, tmp_path):
    shuffled = random.Random(1).sample(names, len(names))
    for name in shuffled:
        (tmp_path / name).touch()
    assert list_images(tmp_path) == names


def test_a_file_of_a_rectified_camera(tmp_path):
    """Images of a folder are raw; a bag asks by the name of its topic."""
    write_image(tmp_path / '0.png', make_image(0))
    write_camera_info(tmp_path, 55.0)
    with (tmp_path / 'camera_info.yaml').open('a') as file:
        file.write('projection_matrix: {data: '
                   f'[{", ".join(numbers([44, 0, 16, 0, 0, 44, 12, 0, 0, 0, 1, 0]).split())}]}}\n')
    assert open_sequence(str(tmp_path)).camera.fx == 55.0
    calibration = read_calibration(tmp_path / 'camera_info.yaml')
    assert open_sequence(str(tmp_path), camera=calibration).camera.fx == 55.0


def test_names_of_files_are_printable(tmp_path):
    """Names are in tables, on terminals and in messages."""
    folder = tmp_path / os.fsdecode(b'a\xe9\x1b[2J')
    write_image(tmp_path / '0.png', make_image(0))
    folder.mkdir()
    (tmp_path / '0.png').rename(folder / '0.png')
    sequence = open_sequence(str(folder))
    assert sequence.name == r'a\udce9\x1b[2J' and len(list(sequence)) == 1
    video = tmp_path / os.fsdecode(b'a\xe9.avi')
    video.write_bytes(b'RIFF')
    with pytest.raises(KfvoError, match='expected a name in UTF-8; rename it'):
        open_sequence(str(video))


def test_what_is_no_image_among_the_images(tmp_path):
    for index in range(3):
        write_image(tmp_path / f'{index}.png', make_image(index))
    (tmp_path / '1.5.png').mkdir()
    assert len(list(open_sequence(str(tmp_path)))) == 3
    os.mkfifo(tmp_path / '3.png')
    with pytest.raises(KfvoError, match=r'3\.png: expected a file, found a FIFO'):
        list(open_sequence(str(tmp_path)))


def test_what_is_no_file_instead_of_a_table_or_a_video(tmp_path):
    path, _ = write_dataset('tum', tmp_path)
    for name, kind in (('rgb.txt', 'tum'), ('walk.avi', 'video')):
        (path / name).unlink(missing_ok=True)
        os.mkfifo(path / name)
        source = path if kind == 'tum' else path / name
        with pytest.raises(KfvoError, match='expected a file, found a FIFO'):
            open_sequence(str(source), kind=kind)
    write_image(tmp_path / 'plain' / '0.png', make_image(0))
    (tmp_path / 'plain' / 'camera_info.yaml').mkdir()
    with pytest.raises(KfvoError, match=r'camera_info\.yaml: expected a file, found a folder'):
        open_sequence(str(tmp_path / 'plain'))
