# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Distortion models against their formulas and inverses, and calibration files."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kfvo_ros.camera import Camera, guess_camera, read_camera_info
from kfvo_ros.errors import KfvoError

EUROC = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, 'radtan',
               (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
FREIBURG1 = Camera(640, 480, 517.306408, 516.469215, 318.643040, 255.313989, 'plumb_bob',
                   (0.262383, -0.953104, -0.005358, 0.002628, 1.163314))
RATIONAL = Camera(640, 480, 400.0, 401.0, 320.0, 240.0, 'rational_polynomial',
                  (0.5, 0.1, 1e-3, -5e-4, 0.02, 0.8, 0.2, 0.03))
WIDE = Camera(640, 480, 300.0, 301.0, 318.0, 255.0, 'plumb_bob', (-0.4, 0.1, 1e-3, -1e-3))
FISHEYE = Camera(1280, 1024, 470.0, 471.0, 641.0, 511.0, 'equidistant',
                 (0.01, -0.005, 0.002, -0.0005))
PINHOLE = Camera(640, 480, 500.0, 501.0, 320.0, 240.0)
CAMERAS = {'euroc': EUROC, 'freiburg1': FREIBURG1, 'rational': RATIONAL, 'wide': WIDE,
           'fisheye': FISHEYE, 'pinhole': PINHOLE}

every_camera = pytest.mark.parametrize('camera', CAMERAS.values(), ids=CAMERAS)


def pixel_grid(camera: Camera) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 25))
    return np.column_stack([x.ravel(), y.ravel()])


def rays_within(degrees: float) -> np.ndarray:
    """Return normalised coordinates (N, 2) of rays up to an angle off the axis."""
    angle, azimuth = np.meshgrid(np.radians(np.linspace(0, degrees, 30)),
                                 np.linspace(0, 2 * np.pi, 24, endpoint=False))
    radius = np.tan(angle).ravel()
    return np.column_stack([radius * np.cos(azimuth.ravel()), radius * np.sin(azimuth.ravel())])


def project_by_formula(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return the pixels by the published formula of the distortion model."""
    x, y = points.T
    radius2 = x * x + y * y
    if camera.distortion_model == 'equidistant':
        radius, angle = np.sqrt(radius2), np.arctan(np.sqrt(radius2))
        k = camera.distortion
        distorted = angle * (1 + sum(k[i] * angle ** (2 * i + 2) for i in range(4)))
        factor = np.where(radius > 0, distorted / np.where(radius > 0, radius, 1), 1.0)
        x, y = factor * x, factor * y
    elif camera.distortion:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*camera.distortion, *[0.0] * 8)[:8]
        factor = ((1 + radius2 * (k1 + radius2 * (k2 + radius2 * k3)))
                  / (1 + radius2 * (k4 + radius2 * (k5 + radius2 * k6))))
        x, y = (factor * x + 2 * p1 * x * y + p2 * (radius2 + 2 * x * x),
                factor * y + p1 * (radius2 + 2 * y * y) + 2 * p2 * x * y)
    return np.column_stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy])


# Projection


@every_camera
def test_distort_is_the_published_model(camera):
    rays = rays_within(30.0)
    np.testing.assert_allclose(camera.distort(rays), project_by_formula(camera, rays), atol=1e-9)


@every_camera
def test_distort_inverts_undistort_at_every_pixel(camera):
    pixels = pixel_grid(camera)
    rays = camera.undistort(pixels)
    valid = np.isfinite(rays).all(axis=1)
    if camera is not FISHEYE:
        assert valid.all()
    np.testing.assert_allclose(camera.distort(rays[valid]), pixels[valid], rtol=0, atol=1e-6)


@every_camera
def test_undistort_inverts_distort_at_every_ray(camera):
    rays = rays_within(75.0 if camera is FISHEYE else 33.0)
    np.testing.assert_allclose(camera.undistort(camera.distort(rays)), rays, rtol=0, atol=1e-9)


def test_fisheye_rays_beyond_the_largest_angle_are_nan():
    pixels = pixel_grid(FISHEYE)
    rays = FISHEYE.undistort(pixels)
    valid = np.isfinite(rays).all(axis=1)
    assert np.isnan(rays[~valid]).all()
    radius = np.hypot(*((pixels - (FISHEYE.cx, FISHEYE.cy)) / (FISHEYE.fx, FISHEYE.fy)).T)
    angles = np.radians([79.9, 80.1])
    inside, outside = angles * (1 + sum(
        k * angles ** (2 * i + 2) for i, k in enumerate(FISHEYE.distortion)))
    assert valid[radius < inside].all() and not valid[radius > outside].any()
    assert (radius < inside).any() and (radius > outside).any()


def test_fisheye_rays_from_behind_are_nan():
    camera = Camera(2000, 2000, 300.0, 300.0, 1000.0, 1000.0, 'equidistant',
                    (1e-9, 0.0, 0.0, 0.0))
    angles = np.radians([60.0, 95.0, 120.0, 175.0])
    rays = camera.undistort(np.column_stack([1000.0 + 300.0 * angles, np.full(4, 1000.0)]))
    assert rays[0, 0] == pytest.approx(math.tan(angles[0]))
    assert np.isnan(rays[1:]).all()


def test_pixels_beyond_the_turning_point_of_the_polynomial_are_nan():
    camera = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, 'plumb_bob', (-0.3, 0.0, 0.0, 0.0))
    turning_point = 1.0 / math.sqrt(0.9)
    farthest = 300.0 * turning_point * (1.0 - 0.3 * turning_point ** 2)
    offset = np.array([-1.001, -0.999, 0.0, 0.5, 0.999, 1.001]) * farthest
    rays = camera.undistort(np.column_stack([320.0 + offset, np.full(6, 240.0)]))
    assert np.isfinite(rays[:, 0]).tolist() == [False, True, True, True, True, False]
    assert (np.abs(rays[1:5, 0]) < turning_point).all()


@every_camera
def test_non_finite_pixels_give_nan_and_no_error(camera):
    rays = camera.undistort(np.array([[np.nan, 3.0], [3.0, np.inf], [camera.cx, camera.cy]]))
    assert not np.isfinite(rays[:2]).all(axis=1).any()
    np.testing.assert_allclose(rays[2], 0.0, atol=1e-12)
    assert camera.undistort(np.zeros((0, 2))).shape == (0, 2)
    assert camera.distort(np.zeros((0, 2))).shape == (0, 2)


def test_matrix_projects_points_of_a_pinhole_camera():
    x, y, w = PINHOLE.matrix @ [0.2, -0.1, 2.0]
    np.testing.assert_allclose([[x / w, y / w]], PINHOLE.distort(np.array([[0.1, -0.05]])))


# Construction


@pytest.mark.parametrize('name, count, model', [
    ('plumb_bob', 5, 'plumb_bob'), ('radtan', 5, 'plumb_bob'),
    ('radial-tangential', 5, 'plumb_bob'), (' Plumb_Bob ', 5, 'plumb_bob'),
    ('rational_polynomial', 8, 'rational_polynomial'), ('equidistant', 4, 'equidistant'),
    ('fisheye', 4, 'equidistant'), ('pinhole', 0, 'none'), ('none', 0, 'none'), ('', 0, 'none')])
def test_models_have_synonyms(name, count, model):
    camera = Camera(4, 4, 1.0, 1.0, 2.0, 2.0, name, (0.1,) * count)
    assert (camera.distortion_model, len(camera.distortion)) == (model, count)


def test_plumb_bob_always_has_a_k3():
    four = Camera(4, 4, 1.0, 1.0, 2.0, 2.0, 'radtan', (0.1, 0.2, 0.3, 0.4))
    assert four == Camera(4, 4, 1.0, 1.0, 2.0, 2.0, 'plumb_bob', (0.1, 0.2, 0.3, 0.4, 0.0))


def test_zero_coefficients_mean_no_distortion():
    camera = Camera(4, 4, 1.0, 1.0, 2.0, 2.0, 'plumb_bob', (0.0,) * 5)
    assert camera == Camera(4, 4, 1.0, 1.0, 2.0, 2.0)
    # The ideal equidistant model has zero coefficients and is no pinhole.
    fisheye = Camera(400, 400, 100.0, 100.0, 200.0, 200.0, 'equidistant', (0.0,) * 4)
    assert fisheye.distort(np.array([[1.0, 0.0]]))[0, 0] == pytest.approx(200 + 25 * math.pi)


@pytest.mark.parametrize('change, message', [
    ({'distortion_model': 'wobbly'}, "unknown distortion model 'wobbly'; expected one of"),
    ({'distortion': (0.1,)}, 'distortion coefficients, 1 came'),
    ({'distortion_model': 'equidistant', 'distortion': (0.1,) * 5}, 'distortion coefficients'),
    ({'distortion_model': 'none'}, 'distortion coefficients'),
    ({'fx': 0.0}, 'fx=0.0'), ({'fy': -5.0}, 'fy=-5.0'), ({'fx': math.nan}, 'fx=nan'),
    ({'cx': math.inf}, 'expected'), ({'distortion': (math.nan,) * 4}, 'expected'),
    ({'readout_s': 30.0}, 'readout_s=30.0'), ({'readout_s': math.nan}, 'readout_s=nan'),
    ({'width': 0}, 'came 0x480'), ({'height': -1}, 'came 640x-1')])
def test_invalid_cameras_are_refused(change, message):
    values = {'width': 640, 'height': 480, 'fx': 500.0, 'fy': 500.0, 'cx': 320.0, 'cy': 240.0,
              'distortion_model': 'plumb_bob', 'distortion': (0.1, 0.0, 0.0, 0.0)}
    Camera(**values)
    with pytest.raises(KfvoError, match=message):
        Camera(**{**values, **change})


def test_guess_has_a_field_of_view_of_sixty_degrees():
    camera = guess_camera(1920, 1080)
    assert camera.guessed and not PINHOLE.guessed
    edges = camera.undistort(np.array([[-0.5, 539.5], [1919.5, 539.5]]))
    np.testing.assert_allclose(np.degrees(np.arctan(edges[:, 0])), [-30.0, 30.0], atol=1e-9)
    np.testing.assert_allclose(edges[:, 1], 0.0, atol=1e-12)


# Resizing


@pytest.mark.parametrize('camera', [EUROC, FISHEYE], ids=['euroc', 'fisheye'])
@pytest.mark.parametrize('factor', [0.5, 0.25, 2.0])
def test_scaled_keeps_the_rays(camera, factor):
    small = camera.scaled(round(camera.width * factor), round(camera.height * factor))
    rays = rays_within(30.0)
    # Pixel centres are whole numbers, so the corner of the image is at -0.5.
    np.testing.assert_allclose(small.distort(rays) + 0.5, factor * (camera.distort(rays) + 0.5),
                               atol=1e-9)


def test_scaled_refuses_another_aspect_ratio():
    kitti = Camera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
    assert kitti.scaled(1241, 376) is kitti
    assert kitti.scaled(620, 188).width == 620
    with pytest.raises(KfvoError, match='is for 1241x376 images, 1241x370 came'):
        kitti.scaled(1241, 370)
    with pytest.raises(KfvoError):
        kitti.scaled(0, 0)


# Calibration files


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
    ('image_width: 640', '', "KeyError\\('image_width'\\)"),
    ('image_width: 640', 'image_width: wide', 'image_width'),
    ('image_width: 640', 'image_width: .inf', 'image_width'),
    ('image_height: 480', 'image_height: 0', 'came 640x0'),
    ('camera_matrix', 'camera_matrices', "KeyError\\('camera_matrix'\\)"),
    ('0, 0, 1]}\ndist', '0, 0]}\ndist', 'camera_matrix holds 8 numbers, expected 9'),
    ('[517.3, ', '[0.0, ', 'is it calibrated'),
    ('517.3', 'nan', 'expected finite numbers, came fx=nan; is it calibrated'),
    ('318.6', '.inf', 'expected finite numbers, came cx=inf; is it calibrated'),
    ('-0.95', '.nan', r'expected finite numbers, came distortion\[1\]=nan; is it calibrated'),
    ('plumb_bob', 'wobbly', "unknown distortion model 'wobbly'"),
    ('1.16', '1.16, 1, 2', 'distortion coefficients, 7 came'),
    ('image_width: 640', 'image_width: 640\nreadout_s: 30', 'readout_s=30.0'),
    ('distortion_coefficients', 'd', "KeyError\\('distortion_coefficients'\\)"),
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
