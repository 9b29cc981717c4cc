# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Datasets with a defect raise a one-line KfvoError that names the file."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from sequence_writers import write_camera_info, write_dataset, write_image, write_text

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence


def broken_datasets() -> dict[str, tuple[str, str, str | None, str]]:
    """Return case -> (dataset, file, new text or None to delete it, expected message)."""
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
                        r'sensor\.yaml: expected a camera calibration .* intrinsics is missing'),
        'sensor.yaml alias': ('euroc', 'mav0/cam0/sensor.yaml', 'a: &a [1]\nb: *a',
                              r'cannot read .*sensor\.yaml: \*a is an alias'),
        'sensor.yaml of another model': (
            'euroc', 'mav0/cam0/sensor.yaml', 'camera_model: omni\nresolution: [32, 24]\n'
            'intrinsics: [30, 30, 16, 12]\ndistortion_model: radtan\n'
            'distortion_coefficients: [0, 0, 0, 0]', "camera_model pinhole, came 'omni'"),
        'sensor.yaml not YAML': ('euroc', 'mav0/cam0/sensor.yaml', 'a: [', r'sensor\.yaml'),
        'sensor.yaml nested': ('euroc', 'mav0/cam0/sensor.yaml', 'a: ' + '[' * 5000,
                             r'cannot read .*sensor\.yaml'),
        'sensor.yaml bad date': ('euroc', 'mav0/cam0/sensor.yaml', 'a: 2001-13-45',
                                r'cannot read .*sensor\.yaml: month'),
        'sensor.yaml bad int': ('euroc', 'mav0/cam0/sensor.yaml', 'a: !!int foo',
                               r"cannot read .*sensor\.yaml: .*'foo'"),
        'sensor.yaml infinite': ('euroc', 'mav0/cam0/sensor.yaml', 'resolution: [.inf, 24]',
                               r'sensor\.yaml: expected a camera.*resolution.*infinity'),
        'sensor.yaml a list': ('euroc', 'mav0/cam0/sensor.yaml', '[1]', r'sensor\.yaml.*keys'),
        'calib.txt': ('kitti', 'calib.txt', 'P0: 1 2 3', r'calib\.txt, line 1.*12 numbers'),
        'calib.txt lacks P0': ('kitti', 'calib.txt', 'P1: ' + '1 ' * 12, r'calib\.txt.*"P0: '),
        'calib.txt of zeros': ('kitti', 'calib.txt', 'P0: ' + '0 ' * 12, r'calib\.txt.*fx=0'),
    }


@pytest.mark.parametrize('case', broken_datasets())
def test_an_error_names_the_broken_file(case, tmp_path):
    kind, file_name, text, message = broken_datasets()[case]
    path, _ = write_dataset(kind, tmp_path)
    (path / file_name).unlink()
    if text is not None:
        write_text(path / file_name, text)
    with pytest.raises(KfvoError, match=message) as caught:
        list(open_sequence(str(path)))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(('kind', 'file_name', 'text', 'message'), [
    ('euroc', 'mav0/state_groundtruth_estimate0/data.csv', '1,2,3', r'line 1.*qw qx qy qz'),
    ('euroc', 'mav0/state_groundtruth_estimate0/data.csv', '1,2,3,4,0,0,0,0', 'line 1'),
    ('euroc', 'mav0/cam0/sensor.yaml', 'T_BS: {data: [1, 2]}', r'T_BS: expected a rigid 4x4'),
    ('tartanair', 'pose_left.txt', '0 0 0 0 0 0 1', r'pose_left\.txt holds 1 poses for 4 frames'),
    ('tartanair', 'pose_left.txt', '0 0 0 0 0 0 0', r'pose_left\.txt, line 1'),
    ('tartanair', 'pose_left.txt', '0 0 inf 0 0 0 1', r'pose_left\.txt, line 1'),
    ('kitti', '../../poses/03.txt', '1 0 0 0 0 1 0 0 0 0 1 0', '1 poses for 4 frames'),
])
def test_an_error_names_the_broken_ground_truth(kind, file_name, text, message, tmp_path):
    path, _ = write_dataset(kind, tmp_path)
    sequence = open_sequence(str(path))
    write_text(path / file_name, text)
    with pytest.raises(KfvoError, match=message):
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


def test_a_calibration_of_another_shape_is_refused(tmp_path):
    path, _ = write_dataset('kitti', tmp_path)
    write_camera_info(path, 55.0, width=640, height=640)
    with pytest.raises(KfvoError, match=r'kitti/03.*640x640.*32x24'):
        open_sequence(str(path))
