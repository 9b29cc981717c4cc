# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a CameraInfo and a calibration file say of raw and of rectified images of a bag."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from bag_writers import LATER_NS, STAMPS_NS, BagBuilder
from sequence_writers import HEIGHT, WIDTH, make_image, write_text

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.bag.camera import camera_from_info, is_rectified
from kfvo_ros.sequences.calibration import read_calibration

K = (500.0, 0, 320, 0, 501, 240, 0, 0, 1)
P = (444.0, 0, 311, -40, 0, 445, 244, 0, 0, 0, 1, 0)
D, E = (0.2, -0.9, -0.005, 0.002, 1.1), (0.1, 0.2, 0.3, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06)
RAW = Camera(640, 480, 500.0, 501.0, 320.0, 240.0, 'plumb_bob', D)
IDEAL = Camera(640, 480, 500.0, 501.0, 320.0, 240.0)
RECTIFIED = Camera(640, 480, 444.0, 445.0, 311.0, 244.0)


def camera_of(rectified: bool = False, **changes) -> Camera | None:
    """Return the camera of a CameraInfo of 640x480 images, with some fields changed."""
    fields = {'width': 640, 'height': 480, 'distortion_model': 'plumb_bob', 'd': np.array(D),
              'k': np.array(K), 'p': np.array(P), 'binning_x': 0, 'binning_y': 0,
              'roi': SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)}
    return camera_from_info(SimpleNamespace(**fields | changes), rectified, 640, 480)


def test_rectified_images_have_the_camera_of_p_or_that_of_k():
    assert camera_of() == RAW
    assert camera_of(rectified=True) == RECTIFIED
    assert camera_of(rectified=True, p=np.zeros(12)) == IDEAL
    assert camera_of(rectified=True, k=np.zeros(9)) == RECTIFIED
    assert camera_of(rectified=True, distortion_model='unheard of') == RECTIFIED


def test_without_focal_lengths_it_is_uncalibrated():
    assert camera_of(k=np.zeros(9)) is None
    assert camera_of(k=np.array([0.0, 0, 0, 0, 0, 0, 0, 0, 1])) is None
    assert camera_of(rectified=True, k=np.zeros(9), p=np.zeros(12)) is None


@pytest.mark.parametrize(('model', 'd', 'expected'), [
    ('plumb_bob', (*D, 0, 0, 0), ('plumb_bob', D)),
    ('plumb_bob', D[:4], ('plumb_bob', (*D[:4], 0))),
    ('plumb_bob', (*D, *E[:3]), ('rational_polynomial', (*D, *E[:3]))),
    ('rational_polynomial', (*D, *E[:7]), ('rational_polynomial', (*D, *E[:7]))),
    ('rational_polynomial', (*D, *E), ('rational_polynomial', (*D, *E))),
    ('equidistant', (*D[:4], 0), ('equidistant', D[:4])), ('plumb_bob', (), ('none', ())),
    ('', D, ('plumb_bob', D)), ('', (), ('none', ())), ('equidistant', (), ('none', ()))])
def test_lengths_of_d(model, d, expected):
    camera = camera_of(distortion_model=model, d=np.array(d, float))
    assert (camera.distortion_model, camera.distortion) == expected


@pytest.mark.parametrize(('fields', 'message'), [
    ({'k': np.array([772.57, 0, 0, 0, 1, 0, 0, 6.9e-310, 2.5e-323])}, 'camera matrix .*772.57'),
    ({'k': np.array([772.57, 0, 320, 0, 1, 240, 0, 0, 1])}, r'came fx=772\.57 fy=1\.0'),
    ({'k': np.array([1e300, 0, 320, 0, 1e300, 240, 0, 0, 1])}, r'fx=1e\+300 fy=1e\+300'),
    ({'k': np.array([500, 0, 1e30, 0, 500, 240, 0, 0, 1])}, r'cx=1e\+30 cy=240\.0'),
    ({'k': np.full(9, np.nan)}, 'camera matrix'), ({'d': np.full(5, np.nan)}, 'finite'),
    ({'d': np.ones(6)}, '6 came'), ({'distortion_model': 'fov'}, "model 'fov'")])
def test_no_calibration_is_refused(fields, message):
    with pytest.raises(KfvoError, match=message):
        camera_of(**fields)


@pytest.mark.parametrize(('topic', 'rectified'), [
    ('/cam/image_rect', True), ('/cam/image_rect_color/compressed', True), ('/rect', True),
    ('/zed/left/color/rect/image', True), ('/cam/image_undistorted', True),
    ('/infra1/image_rect_raw', True), ('/cam/image_raw', False), ('/cam/direct', False),
    ('/rectangle/image', False), ('/rect_robot/cam/image_raw', False),
    ('/cam/corrected', False), ('/director/image', False)])
def test_names_of_rectified_topics(topic, rectified):
    assert is_rectified(topic) == rectified


def test_a_file_has_the_cameras_of_raw_and_of_rectified_topics(tmp_path):
    """They are never undistorted twice, whether the file is the user's or in the folder."""
    writer = BagBuilder('mcap')
    records = [(topic, stamp_ns + LATER_NS, writer.image(stamp_ns, make_image(index)))
               for index, stamp_ns in enumerate(STAMPS_NS)
               for topic in ('/cam/image_raw', '/cam/image_rect')]
    path = writer.write(tmp_path / 'walk', records)
    file = tmp_path / 'ost.yaml'
    write_text(file, f'image_width: {WIDTH}', f'image_height: {HEIGHT}',
               'camera_matrix: {data: [33, 0, 16, 0, 33, 12, 0, 0, 1]}',
               'distortion_model: plumb_bob', 'distortion_coefficients: {data: [-0.2, 0.1, 0, 0]}',
               'projection_matrix: {data: [44, 0, 15, 0, 0, 44, 11, 0, 0, 0, 1, 0]}')
    raw = Camera(WIDTH, HEIGHT, 33.0, 33.0, 16.0, 12.0, 'plumb_bob', (-0.2, 0.1, 0.0, 0.0))
    rectified = Camera(WIDTH, HEIGHT, 44.0, 44.0, 15.0, 11.0)
    expected = {'/cam/image_raw': raw, '/cam/image_rect': rectified}
    for topic, camera in expected.items():
        assert open_sequence(str(path), image_topic=topic,
                             camera=read_calibration(file)).camera == camera
    file.rename(path / 'camera_info.yaml')
    for topic, camera in expected.items():
        assert open_sequence(str(path), image_topic=topic).camera == camera
        assert open_sequence(str(path), image_topic=topic, camera=raw).camera == raw
