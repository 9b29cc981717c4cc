# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Datasets, folders and videos: read back as they were written, or refused in one line."""

from __future__ import annotations

import itertools
import logging
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from sequence_writers import (
    HEIGHT,
    WIDTH,
    make_image,
    make_poses,
    write_camera_info,
    write_euroc,
    write_image,
    write_kitti,
    write_tartanair,
    write_text,
    write_tum,
)

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import KINDS, open_sequence

WRITERS = {'euroc': write_euroc, 'tum': write_tum, 'kitti': write_kitti,
           'tartanair': write_tartanair}
COUNT = 4
EASY = Camera(WIDTH, HEIGHT, 99.0, 99.0, 16.0, 12.0)

every_dataset = pytest.mark.parametrize('kind', WRITERS)


def write_dataset(kind: str, root: Path, colour: bool = False) -> tuple[Path, list[int]]:
    images = [make_image(index, colour) for index in range(COUNT)]
    return WRITERS[kind](root, images, make_poses(COUNT))


@pytest.mark.parametrize('colour', [False, True])
@every_dataset
def test_datasets_read_back(kind, colour, tmp_path):
    path, stamps_ns = write_dataset(kind, tmp_path, colour)
    sequence = open_sequence(str(path))
    for _ in range(2):  # as often as you like
        frames = list(sequence)
        assert [frame.stamp_ns for frame in frames] == stamps_ns
        assert all(type(frame.stamp_ns) is int for frame in frames)
        for index, frame in enumerate(frames):
            np.testing.assert_array_equal(frame.image, make_image(index, colour))
            assert frame.camera == sequence.camera
    assert sequence.length == COUNT
    truth = sequence.ground_truth()
    assert truth.frame == 'camera' and truth.trajectory.has_rotation
    assert truth.trajectory.stamps_ns.tolist() == stamps_ns
    np.testing.assert_allclose(truth.trajectory.poses, make_poses(COUNT), atol=1e-12)


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


def test_euroc_opens_by_mav0_too(tmp_path, monkeypatch):
    path, stamps_ns = write_dataset('euroc', tmp_path)
    write_camera_info(path, 77.0)
    by_parent = open_sequence(str(path))
    monkeypatch.chdir(path / 'mav0')
    by_mav0 = open_sequence('.')
    assert by_mav0.name == by_parent.name == 'V1_01'
    assert by_mav0.camera == by_parent.camera
    assert [frame.stamp_ns for frame in by_mav0] == stamps_ns


def test_kitti_falls_back_to_colour(tmp_path):
    """image_2 has its own P2, and stands beside the camera 0 that the poses are of."""
    images = [make_image(index, colour=True) for index in range(COUNT)]
    path, _ = write_kitti(tmp_path, images, make_poses(COUNT), camera='image_2')
    sequence = open_sequence(str(path))
    assert sequence.camera == Camera(WIDTH, HEIGHT, 40.0, 40.0, 15.0, 11.0)
    np.testing.assert_allclose(sequence.ground_truth().trajectory.poses, make_poses(COUNT),
                               atol=1e-12)
    write_kitti(tmp_path, [make_image(9)] * COUNT, make_poses(COUNT))
    assert open_sequence(str(path)).camera.fx == 30.0  # grey once it is there


@every_dataset
def test_camera_precedence(kind, tmp_path, caplog):
    """The user's, then the file's, then the dataset's own; none of them is a guess."""
    path, _ = write_dataset(kind, tmp_path)
    own = open_sequence(str(path)).camera
    write_camera_info(path, 55.0)
    assert open_sequence(str(path)).camera.fx == 55.0 != own.fx
    assert open_sequence(str(path), camera=EASY).camera == EASY
    assert not own.guessed and not caplog.records


def test_no_ground_truth(tmp_path):
    truths = {'euroc': 'mav0/state_groundtruth_estimate0/data.csv', 'tum': 'groundtruth.txt',
              'kitti': '../../poses/03.txt', 'tartanair': 'pose_left.txt'}
    for kind, truth in truths.items():
        path, _ = write_dataset(kind, tmp_path)
        (path / truth).unlink()
        assert open_sequence(str(path), kind=kind).ground_truth() is None


def test_a_calibration_of_another_shape_is_refused(tmp_path):
    path, _ = write_dataset('kitti', tmp_path)
    write_camera_info(path, 55.0, width=640, height=640)
    with pytest.raises(KfvoError, match=r'kitti/03.*640x640.*32x24'):
        open_sequence(str(path))


def write_folder(folder: Path, names: list[str]) -> Path:
    for index, name in enumerate(names):
        write_image(folder / name, make_image(index))
    return folder


def test_folder_in_natural_order(tmp_path, caplog):
    path = write_folder(tmp_path / 'walk', ['f1.png', 'f2.png', 'f10.png', 'f11.bmp'])
    write_text(path / 'notes.txt', 'no image')
    write_text(path / '._f1.png', 'what a Mac leaves on a memory stick')
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


def test_stamps_that_do_not_increase_are_left_out_with_one_warning(tmp_path, caplog):
    path, stamps_ns = write_dataset('tum', tmp_path)
    lines = (path / 'rgb.txt').read_text().splitlines()
    write_text(path / 'rgb.txt', *lines[:4], lines[3], lines[2], *lines[4:])
    sequence = open_sequence(str(path))
    assert [frame.stamp_ns for frame in sequence] == stamps_ns
    assert sequence.length == COUNT
    warning, = caplog.records
    assert 'left out 2 images' in warning.message


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
def test_what_is_no_sequence_is_told_how_each_kind_looks(name, tmp_path):
    (tmp_path / 'empty').mkdir()
    write_text(tmp_path / 'notes.txt', 'no sequence')
    with pytest.raises(KfvoError) as caught:
        open_sequence(str(tmp_path / name))
    message = str(caught.value)
    assert ('does not exist' in message) == (name == 'missing')
    assert all(kind.looks_like in message for kind in KINDS.values())
    assert 'synthetic:SEED' in message and '\n' not in message


def test_kind_can_be_forced(tmp_path):
    path, _ = write_dataset('kitti', tmp_path)
    sequence = open_sequence(str(path / 'image_0'), kind='folder')
    assert (sequence.name, sequence.length) == ('image_0', COUNT)
    with pytest.raises(KfvoError, match=r'cannot read .*rgb\.txt'):
        open_sequence(str(path), kind='tum')
    with pytest.raises(KfvoError, match='unknown kind.*pgm.*euroc, tum'):
        open_sequence(str(path), kind='pgm')


def broken_datasets() -> dict[str, tuple[str, str, str | None, str]]:
    """Return case -> (dataset, file, its new text or None to delete it, the complaint)."""
    return {
        'image missing': ('euroc', f'mav0/cam0/data/{1403715273262142976 + 50_000_001}.png', None,
                          r'cannot read the image .*1403715273312142977\.png'),
        'image broken': ('kitti', 'image_0/000002.png', 'junk', r'image .*000002\.png'),
        'first image broken': ('tum', 'rgb/1305031229.528748.png', '', r'1305031229\.528748\.png'),
        'no image listed': ('tum', 'rgb.txt', '# empty', 'none is listed'),
        'image stamp': ('euroc', 'mav0/cam0/data.csv', '12.5,a.png', r'data\.csv, line 1.*12\.5'),
        'rgb.txt': ('tum', 'rgb.txt', '# a comment\nyesterday a.png', r'rgb\.txt, line 2'),
        'rgb.txt short': ('tum', 'rgb.txt', '1.5', r'rgb\.txt, line 1: expected "timestamp'),
        'times.txt': ('kitti', 'times.txt', '0\nnan', r'times\.txt, line 2'),
        'sensor.yaml': ('euroc', 'mav0/cam0/sensor.yaml', 'resolution: [32, 24]',
                        r"sensor\.yaml: expected resolution.*'intrinsics'"),
        'sensor.yaml no YAML': ('euroc', 'mav0/cam0/sensor.yaml', 'a: [', r'sensor\.yaml'),
        'sensor.yaml a list': ('euroc', 'mav0/cam0/sensor.yaml', '[1]', r'sensor\.yaml.*keys'),
        'calib.txt': ('kitti', 'calib.txt', 'P0: 1 2 3', r'calib\.txt, line 1.*12 numbers'),
        'calib.txt lacks P0': ('kitti', 'calib.txt', 'P1: ' + '1 ' * 12, r'calib\.txt.*"P0: '),
        'calib.txt of zeros': ('kitti', 'calib.txt', 'P0: ' + '0 ' * 12, r'calib\.txt.*fx=0'),
    }


@pytest.mark.parametrize('case', broken_datasets())
def test_broken_datasets_are_refused_by_name(case, tmp_path):
    kind, file_name, text, complaint = broken_datasets()[case]
    path, _ = write_dataset(kind, tmp_path)
    (path / file_name).unlink()
    if text is not None:
        write_text(path / file_name, text)
    with pytest.raises(KfvoError, match=complaint) as caught:
        list(open_sequence(str(path)))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(('kind', 'file_name', 'text', 'complaint'), [
    ('euroc', 'mav0/state_groundtruth_estimate0/data.csv', '1,2,3', r'line 1.*q w x y z'),
    ('euroc', 'mav0/state_groundtruth_estimate0/data.csv', '1,2,3,4,0,0,0,0', 'line 1'),
    ('euroc', 'mav0/cam0/sensor.yaml', 'T_BS: {data: [1, 2]}', r'T_BS: expected a rigid 4x4'),
    ('euroc', 'mav0/cam0/sensor.yaml', 'comment: none', 'expected T_BS'),
    ('tartanair', 'pose_left.txt', '0 0 0 0 0 0 1', r'pose_left\.txt holds 1 poses for 4 images'),
    ('tartanair', 'pose_left.txt', '0 0 0 0 0 0 0', r'pose_left\.txt, line 1'),
    ('tartanair', 'pose_left.txt', '0 0 inf 0 0 0 1', r'pose_left\.txt, line 1'),
    ('kitti', '../../poses/03.txt', '1 0 0 0 0 1 0 0 0 0 1 0', '1 poses for 4 frames'),
])
def test_broken_ground_truth_is_refused_by_name(kind, file_name, text, complaint, tmp_path):
    path, _ = write_dataset(kind, tmp_path)
    sequence = open_sequence(str(path))
    write_text(path / file_name, text)
    with pytest.raises(KfvoError, match=complaint):
        sequence.ground_truth()


def test_an_image_of_another_size_is_refused(tmp_path):
    path, _ = write_dataset('tartanair', tmp_path)
    write_image(path / 'image_left' / '000002_left.png', np.zeros((10, 12), np.uint8))
    frames = iter(open_sequence(str(path)))
    assert len(list(itertools.islice(frames, 2))) == 2
    with pytest.raises(KfvoError, match=r'000002_left\.png is 12x10.*32x24'):
        next(frames)


def test_kitti_without_images(tmp_path):
    write_text(tmp_path / 'times.txt', '0.0')
    with pytest.raises(KfvoError, match='image_0 or image_2'):
        open_sequence(str(tmp_path), kind='kitti')


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

    assert peak_images(keep=True) > 50  # the measurement sees images
    assert peak_images(keep=False) < 5
