# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Distortion models against their formulas and inverses, and what no camera is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from kfvo_ros.camera import Camera, guess_camera
from kfvo_ros.errors import KfvoError

EUROC = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, 'radtan',
               (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
FREIBURG1 = Camera(640, 480, 517.306408, 516.469215, 318.643040, 255.313989, 'plumb_bob',
                   (0.262383, -0.953104, -0.005358, 0.002628, 1.163314))
RATIONAL = Camera(640, 480, 400.0, 401.0, 320.0, 240.0, 'rational_polynomial',
                  (0.5, 0.1, 1e-3, -5e-4, 0.02, 0.8, 0.2, 0.03))
THIN_PRISM = replace(RATIONAL, distortion=(*RATIONAL.distortion, 1e-3, -2e-3, 3e-3, 1e-3))
TILTED = replace(RATIONAL, distortion=(*THIN_PRISM.distortion, 0.02, -0.03))
WIDE = Camera(640, 480, 300.0, 301.0, 318.0, 255.0, 'plumb_bob', (-0.4, 0.1, 1e-3, -1e-3))
FISHEYE = Camera(1280, 1024, 470.0, 471.0, 641.0, 511.0, 'equidistant',
                 (0.01, -0.005, 0.002, -0.0005))
PINHOLE = Camera(640, 480, 500.0, 501.0, 320.0, 240.0)
CAMERAS = {'euroc': EUROC, 'freiburg1': FREIBURG1, 'rational': RATIONAL,
           'thin_prism': THIN_PRISM, 'wide': WIDE, 'fisheye': FISHEYE, 'pinhole': PINHOLE}

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
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*camera.distortion, *[0.0] * 12)[:12]
        factor = ((1 + radius2 * (k1 + radius2 * (k2 + radius2 * k3)))
                  / (1 + radius2 * (k4 + radius2 * (k5 + radius2 * k6))))
        x, y = (factor * x + 2 * p1 * x * y + p2 * (radius2 + 2 * x * x)
                + radius2 * (s1 + radius2 * s2),
                factor * y + p1 * (radius2 + 2 * y * y) + 2 * p2 * x * y
                + radius2 * (s3 + radius2 * s4))
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


def test_a_tilted_sensor_reads_back():
    pixels = pixel_grid(TILTED)
    rays = TILTED.undistort(pixels)
    np.testing.assert_allclose(TILTED.distort(rays), pixels, rtol=0, atol=1e-6)
    assert np.linalg.norm(rays - THIN_PRISM.undistort(pixels), axis=1).max() > 1e-3


def test_matrix_projects_points_of_a_pinhole_camera():
    x, y, w = PINHOLE.matrix @ [0.2, -0.1, 2.0]
    np.testing.assert_allclose([[x / w, y / w]], PINHOLE.distort(np.array([[0.1, -0.05]])))


# Construction


@pytest.mark.parametrize('name, count, model', [
    ('plumb_bob', 5, 'plumb_bob'), ('radtan', 5, 'plumb_bob'),
    ('radial-tangential', 5, 'plumb_bob'), (' Plumb_Bob ', 5, 'plumb_bob'),
    ('rational_polynomial', 8, 'rational_polynomial'), ('equidistant', 4, 'equidistant'),
    ('fisheye', 4, 'equidistant'), ('pinhole', 0, 'none'), ('none', 0, 'none'), ('', 0, 'none'),
    ('', 5, 'plumb_bob'), ('', 8, 'rational_polynomial'), ('plumb_bob', 8, 'rational_polynomial'),
    ('plumb_bob', 12, 'rational_polynomial'), ('rational_polynomial', 14, 'rational_polynomial'),
    ('rational_polynomial', 5, 'plumb_bob'), ('Brown Conrady', 5, 'plumb_bob'),
    ('Kannala Brandt4', 4, 'equidistant'), ('equidistant', 0, 'none')])
def test_models_have_synonyms(name, count, model):
    camera = Camera(4, 4, 1.0, 1.0, 2.0, 2.0, name, (0.1,) * count)
    assert (camera.distortion_model, len(camera.distortion)) == (model, count)


def test_plumb_bob_always_has_a_k3():
    four = Camera(4, 4, 1.0, 1.0, 2.0, 2.0, 'radtan', (0.1, 0.2, 0.3, 0.4))
    assert four == Camera(4, 4, 1.0, 1.0, 2.0, 2.0, 'plumb_bob', (0.1, 0.2, 0.3, 0.4, 0.0))


@pytest.mark.parametrize(('model', 'used', 'zeros'), [
    ('plumb_bob', 5, 3), ('plumb_bob', 4, 8), ('equidistant', 4, 1), ('equidistant', 4, 10),
    ('rational_polynomial', 8, 1), ('rational_polynomial', 12, 1)])
def test_surplus_zeros_are_left_out(model, used, zeros):
    coefficients = tuple(0.1 / (index + 1) for index in range(used))
    expected = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, model, coefficients)
    assert Camera(640, 480, 500.0, 500.0, 320.0, 240.0, model,
                  coefficients + (0.0,) * zeros) == expected
    assert expected.distortion[:used] == coefficients


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
    ({'width': 0}, 'came 0x480'), ({'height': -1}, 'came 640x-1'),
    ({'fx': 772.57, 'fy': 1.0}, r'fx like fy; came fx=772\.57 fy=1\.0; is it calibrated'),
    ({'fx': 500.0, 'fy': 2001.0}, r'came fx=500\.0 fy=2001\.0'),
    ({'fx': 1e300, 'fy': 1e300}, r'32 to 640000 px .*came fx=1e\+300 fy=1e\+300'),
    ({'fx': 1e-300, 'fy': 1e-300}, 'came fx=1e-300 fy=1e-300'),
    ({'fx': 0.8, 'fy': 0.8}, 'is it calibrated, in pixels'),
    ({'cx': 1e30}, r'principal point in or near the 640x480 image, came cx=1e\+30 cy=240\.0'),
    ({'cy': -1001.0}, 'came cx=320.0 cy=-1001.0'),
    ({'distortion': (0.1,) * 6}, '4 or 5 or 8 or 12 or 14 distortion coefficients, 6 came'),
    ({'distortion': (1e300, 0.0, 0.0, 0.0)}, r'distortion of a lens, came plumb_bob \[1e\+300'),
    ({'distortion': (99.0, 0.0, 0.0, 0.0)}, 'shifts pixels by 10.1 times their distance'),
    ({'distortion': (0.0, 0.0, 0.0, 1e3)}, 'distortion of a lens'),
    ({'distortion_model': 'equidistant', 'distortion': (0.0, 0.0, 1e200, 0.0)}, 'of a lens')])
def test_invalid_cameras_are_refused(change, message):
    values = {'width': 640, 'height': 480, 'fx': 500.0, 'fy': 500.0, 'cx': 320.0, 'cy': 240.0,
              'distortion_model': 'plumb_bob', 'distortion': (0.1, 0.0, 0.0, 0.0)}
    Camera(**values)
    with pytest.raises(KfvoError, match=message):
        Camera(**{**values, **change})


@pytest.mark.parametrize('values', [
    {'fx': 640.0 / 4.2, 'fy': 640.0 / 4.2},  # an equidistant lens of 240 degrees
    {'fx': 40000.0, 'fy': 40000.0}, {'fx': 500.0, 'fy': 1000.0},
    {'cx': -900.0, 'cy': 1400.0}])  # a region beside the axis of the lens
def test_unusual_cameras_are_taken(values):
    Camera(**{'width': 640, 'height': 480, 'fx': 500.0, 'fy': 500.0, 'cx': 320.0, 'cy': 240.0}
           | values)


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
