# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files of every form, raw and rectified, and broken ones."""

from __future__ import annotations

import logging

import pytest

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.calibration import (
    CameraCalibration,
    read_calibration,
    read_camera_info,
    write_camera_info,
)

CALIBRATION = """
image_width: 640
image_height: 480
camera_name: head
camera_matrix: {rows: 3, cols: 3, data: [517.3, 0.0, 318.6, 0, 516.5, 255.3, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.26, -0.95, -0.005, 0.0026, 1.16]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""


def test_a_calibration_is_read(tmp_path):
    path = tmp_path / 'camera_info.yaml'
    path.write_text(CALIBRATION)
    assert read_camera_info(path) == Camera(640, 480, 517.3, 516.5, 318.6, 255.3, 'plumb_bob',
                                            (0.26, -0.95, -0.005, 0.0026, 1.16))
    path.write_text(CALIBRATION + 'readout_s: 0.03\n')
    assert read_camera_info(path).readout_s == 0.03


@pytest.mark.parametrize('old, new, message', [
    ('image_width: 640', '', 'image_width is missing'),
    ('image_width: 640', 'image_width: wide', 'image_width'),
    ('image_width: 640', 'image_width: .inf', 'image_width'),
    ('image_height: 480', 'image_height: 0', 'came 640x0'),
    ('camera_matrix', 'camera_matrices', 'camera_matrix.* intrinsics is missing'),
    ('0, 0, 1]}\ndist', '0, 0]}\ndist', 'camera_matrix holds 8 numbers, expected 9'),
    ('[517.3, ', '[0.0, ', 'is it calibrated'),
    ('517.3', 'nan', 'expected finite numbers, came fx=nan; is it calibrated'),
    ('318.6', '.inf', 'expected finite numbers, came cx=inf; is it calibrated'),
    ('-0.95', '.nan', r'expected finite numbers, came distortion\[1\]=nan; is it calibrated'),
    ('plumb_bob', 'wobbly', "unknown distortion model 'wobbly'"),
    ('1.16', '1.16, 1, 2', 'distortion coefficients, 7 came'),
    ('image_width: 640', 'image_width: 640\nreadout_s: 30', 'readout_s=30.0'),
    ('distortion_coefficients', 'coefficients', 'distortion_coefficients is missing'),
    ('{rows: 1, cols: 5, data: [0.26,', '[[0.26,', 'cannot read the calibration'),
    ('image_width: 640', '!!python/object/apply:os.getcwd []', 'cannot read the calibration'),
    ('image_width: 640', 'image_width: ' + '[' * 5000, 'cannot read the calibration'),
    ('640', '2001-13-45', 'cannot read the calibration .*month'),
    ('640', '!!int foo', "cannot read the calibration .*'foo'"),
    ('640', '!!float x', "cannot read the calibration .*'x'"),
    ('640', '0x_', 'cannot read the calibration .*base 16'),
    ('640', '!!bool x', 'cannot read the calibration'),
    ('640', '!!int ""', 'cannot read the calibration'),
    ('640', '!!timestamp x', 'cannot read the calibration')])
def test_the_error_names_a_bad_calibration(tmp_path, old, new, message):
    assert old in CALIBRATION
    path = tmp_path / 'camera_info.yaml'
    path.write_text(CALIBRATION.replace(old, new, 1))
    with pytest.raises(KfvoError, match=message) as caught:
        read_camera_info(path)
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('text', ['', 'just words', '- a\n- list', '5', '\x00'])
def test_a_file_without_a_calibration_is_refused(tmp_path, text):
    path = tmp_path / 'camera_info.yaml'
    path.write_text(text)
    with pytest.raises(KfvoError, match='camera_info.yaml'):
        read_camera_info(path)


def test_the_error_names_an_unreadable_calibration(tmp_path):
    with pytest.raises(KfvoError, match='cannot read the calibration .*missing.yaml'):
        read_camera_info(tmp_path / 'missing.yaml')
    (tmp_path / 'image.yaml').write_bytes(b'\x89PNG\xff\xfe')
    with pytest.raises(KfvoError, match='cannot read the calibration .*image.yaml'):
        read_camera_info(tmp_path / 'image.yaml')


# Other forms

RAW = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, 'plumb_bob',
             (0.26, -0.95, -0.005, 0.0026, 1.16))
RECTIFIED = Camera(640, 480, 444.0, 445.0, 311.0, 244.0)
PROJECTION = ('projection_matrix: {rows: 3, cols: 4, data: '
              '[444, 0, 311, -40, 0, 445, 244, 0, 0, 0, 1, 0]}\n')
OPENCV = """%YAML:1.0
---
calibration_time: "Mon 01 Jan 2024"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.173e+02, 0., 3.186e+02, 0., 5.165e+02, 2.553e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.26, -0.95, -5.e-03, 2.6e-03, 1.16 ]
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.26, -0.95, -0.005, 0.0026]
  distortion_model: radtan
  intrinsics: [517.3, 516.5, 318.6, 255.3]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  distortion_model: equidistant
  intrinsics: [500.0, 500.0, 320.0, 240.0]
  resolution: [640, 480]
"""
ECHO = """header:
  stamp:
    sec: 1
    nanosec: 2
  frame_id: cam
height: 480
width: 640
distortion_model: plumb_bob
d:
- 0.26
- -0.95
- -0.005
- 0.0026
- 1.16
k: [517.3, 0.0, 318.6, 0.0, 516.5, 255.3, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [444.0, 0.0, 311.0, 0.0, 0.0, 445.0, 244.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
---
header:
  stamp:
"""
OST = """# oST version 5.0 parameters


[image]

width
640

height
480

[narrow_stereo]

camera matrix
517.300000 0.000000 318.600000
0.000000 516.500000 255.300000
0.000000 0.000000 1.000000

distortion
0.260000 -0.950000 -0.005000 0.002600 1.160000

rectification
1 0 0
0 1 0
0 0 1

projection
444.000000 0.000000 311.000000 0.000000
0.000000 445.000000 244.000000 0.000000
0.000000 0.000000 1.000000 0.000000
"""
ROS1_ECHO = ECHO.replace('\nd:', '\nD:').replace('\nk:', '\nK:').replace('\np:', '\nP:')
FORMS = {'ros': CALIBRATION, 'bom': '\ufeff' + CALIBRATION.replace('\n', '\r\n'),
         'opencv': OPENCV, 'opencv_old': OPENCV.replace('image_width', 'image_Width').replace(
             'camera_matrix', 'Camera_Matrix').replace('distortion_c', 'Distortion_C'),
         'echo': ECHO, 'ros1_echo': ROS1_ECHO, 'ini': OST}


@pytest.mark.parametrize('form', FORMS)
def test_forms(form, tmp_path):
    path = tmp_path / 'calibration'
    path.write_text(FORMS[form], encoding='utf-8')
    assert read_camera_info(path) == RAW


def test_kalibr(tmp_path, caplog):
    """The first of several cameras is taken and named."""
    path = tmp_path / 'camchain.yaml'
    path.write_text(KALIBR)
    assert read_camera_info(path) == Camera(640, 480, 517.3, 516.5, 318.6, 255.3, 'plumb_bob',
                                            RAW.distortion[:4])
    assert 'using the calibration of cam0; others are: cam1' in caplog.messages[0]
    path.write_text(KALIBR[KALIBR.index('cam1'):])
    assert read_camera_info(path).distortion_model == 'equidistant'
    path.write_text(KALIBR.replace('camera_model: pinhole', 'camera_model: omni', 1))
    with pytest.raises(KfvoError, match="expected camera_model pinhole, came 'omni'"):
        read_camera_info(path)


def test_a_missing_model_is_plumb_bob(tmp_path, caplog):
    path = tmp_path / 'camera_info.yaml'
    path.write_text(CALIBRATION.replace('distortion_model: plumb_bob\n', ''))
    assert read_camera_info(path) == RAW
    assert 'names no distortion_model: plumb_bob is assumed' in caplog.messages[0]
    assert caplog.records[0].levelno == logging.WARNING
    path.write_text(CALIBRATION.replace('distortion_model: plumb_bob', 'fisheye_model: 1')
                    .replace(', 1.16', ''))
    assert read_camera_info(path).distortion_model == 'equidistant'


@pytest.mark.parametrize('empty', ['{rows: 1, cols: 0, data: []}', '{data: }', '[]'])
def test_no_coefficients_are_no_distortion(empty, tmp_path):
    path = tmp_path / 'camera_info.yaml'
    start = CALIBRATION[:CALIBRATION.index('distortion_coefficients')]
    path.write_text(f'{start}distortion_coefficients: {empty}\n')
    assert read_camera_info(path) == Camera(640, 480, 517.3, 516.5, 318.6, 255.3)


# Rectified images


@pytest.mark.parametrize('text', [CALIBRATION + PROJECTION, ECHO, OST])
def test_rectified_images_have_the_camera_of_p(text, tmp_path):
    path = tmp_path / 'ost'
    path.write_text(text)
    assert read_calibration(path).camera(rectified=True) == RECTIFIED
    assert read_camera_info(path, rectified=True) == RECTIFIED
    assert read_calibration(path).camera() == RAW


@pytest.mark.parametrize('text', [CALIBRATION, CALIBRATION
                                  + 'projection_matrix: {data: [0, 0, 0, 0]}\n'])
def test_rectified_images_without_p_have_that_of_k(text, tmp_path):
    path = tmp_path / 'ost.yaml'
    path.write_text(text)
    assert read_camera_info(path, rectified=True) == Camera(640, 480, 517.3, 516.5, 318.6, 255.3)


def test_a_broken_p_concerns_rectified_images_only(tmp_path):
    path = tmp_path / 'ost.yaml'
    path.write_text(CALIBRATION + PROJECTION.replace('0, 0, 1, 0]', '0, 0, 0, 1]'))
    assert read_camera_info(path) == RAW
    with pytest.raises(KfvoError, match=r'ost\.yaml: expected a camera matrix .* came 444 0 311 0 '
                       '445 244 0 0 0'):
        read_camera_info(path, rectified=True)


# Numbers that are no calibration


@pytest.mark.parametrize(('K', 'message'), [
    ([772.57, 0, 0, 0, 1.0, 0, 0, 6.9e-310, 2.5e-323], 'came 772.57 0 0 0 1 0 0 6.9e-310'),
    ([500.0, 0, 320, 0, 500, 240, 0, 0, 0], 'expected a camera matrix fx 0 cx 0 fy cy 0 0 1'),
    ([500.0, 0, 0, 0, 500, 0, 320, 240, 1], 'came 500 0 0 0 500 0 320 240 1'),
    ([500.0, 320, 0, 0, 500, 240, 0, 0, 1], 'came 500 320 0'),
    ([500.0, 0, 320, 0, 500, 240, 0, 0, float('nan')], 'expected a camera matrix'),
    ([500.0, 0, 320, 0, 1, 240, 0, 0, 1], 'came fx=500.0 fy=1.0'),
    ([500.0, 0, 1e30, 0, 500, 240, 0, 0, 1], r'came cx=1e\+30 cy=240.0'),
    ([500.0] * 8, 'camera_matrix holds 8 numbers, expected 9'), (None, 'holds 0 numbers'),
    ('500 0 320', 'problem: could not convert string')])
def test_other_matrices_are_refused(K, message):
    with pytest.raises(KfvoError, match=message) as caught:
        CameraCalibration(640, 480, K, (), source='/cam/camera_info').camera()
    assert str(caught.value).startswith('/cam/camera_info: ')


def test_a_small_skew_is_neglected():
    calibration = CameraCalibration(640, 480, [500.0, 2.0, 320, 0, 500, 240, 0, 0, 1], ())
    assert calibration.camera() == Camera(640, 480, 500.0, 500.0, 320.0, 240.0)


def test_what_is_written_reads_back(tmp_path):
    for camera in (RAW, RECTIFIED):
        write_camera_info(tmp_path / 'camera_info.yaml', camera)
        assert read_camera_info(tmp_path / 'camera_info.yaml') == camera
