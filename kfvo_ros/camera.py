# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Camera intrinsics and distortion."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import dataclass, replace

import cv2
import numpy as np

from kfvo_ros.errors import KfvoError

PLUMB_BOB, RATIONAL = 'plumb_bob', 'rational_polynomial'
"""OpenCV's polynomial models; the number of coefficients decides which."""
DISTORTION_SIZES = {'none': (0,), PLUMB_BOB: (4, 5), RATIONAL: (8, 12, 14), 'equidistant': (4,)}
"""Distortion models by ROS name, with their possible numbers of coefficients."""
POLYNOMIAL_SIZES = (*DISTORTION_SIZES[PLUMB_BOB], *DISTORTION_SIZES[RATIONAL])
MODEL_SYNONYMS = {
    'none': 'none', 'pinhole': 'none', 'plumbbob': PLUMB_BOB, 'radtan': PLUMB_BOB,
    'radialtangential': PLUMB_BOB, 'opencv': PLUMB_BOB, 'brownconrady': PLUMB_BOB,
    'modifiedbrownconrady': PLUMB_BOB, 'inversebrownconrady': PLUMB_BOB, 'rational': RATIONAL,
    'rationalpolynomial': RATIONAL, 'thinprism': RATIONAL, 'equidistant': 'equidistant',
    'equi': 'equidistant', 'fisheye': 'equidistant', 'opencvfisheye': 'equidistant',
    'kannalabrandt': 'equidistant', 'kannalabrandt4': 'equidistant'}
"""Names of the models, as `plain_name` writes them."""
FOCAL_RANGE = (0.05, 1000.0)
"""Plausible focal lengths in units of the image's longer side."""
MAX_PIXEL_ASPECT = 4.0
"""Largest ratio of fx and fy: pixels may be binned in one direction."""
MAX_CENTRE_OFFSET = 2.0
"""How far the principal point may lie outside of the image, in focal lengths."""
MAX_SHIFT = 2.0
"""Largest shift by distortion, relative to the distance from the axis, halfway to the edge."""
NEWTON_STEPS = 15
"""Moderate distortion converges in three steps, the corners of a wide-angle image in eight."""
CONVERGED = 1e-7
"""Convergence is quadratic: after a step of this size the error is about 1e-14."""
MAX_VIEW_ANGLE = math.radians(80.0)
"""Rays farther off the axis have no usable pinhole coordinates."""
MAX_READOUT = 0.2
"""Longest plausible readout time [s]; a larger number is probably in milliseconds."""


@dataclass(frozen=True)
class Camera:
    """A calibrated camera: pinhole intrinsics [px] and a ROS distortion model.

    Pixel centres are at whole coordinates. ``distortion`` is in OpenCV's order (k1 k2 p1 p2 k3
    ...; equidistant: k1 k2 k3 k4). ``guessed`` marks intrinsics that were not measured.
    ``readout_s`` is the time between the first and the last row of a rolling shutter [s], zero
    for a global shutter.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str = 'none'
    distortion: tuple[float, ...] = ()
    guessed: bool = False
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        model, coefficients = _distortion(self.distortion_model,
                                          tuple(float(value) for value in self.distortion))
        numbers = {'fx': self.fx, 'fy': self.fy, 'cx': self.cx, 'cy': self.cy} | {
            f'distortion[{index}]': value for index, value in enumerate(coefficients)}
        bad = [f'{name}={value}' for name, value in numbers.items() if not math.isfinite(value)]
        if bad:
            raise KfvoError(f'expected finite numbers, came {" ".join(bad)}; is it calibrated?')
        if min(self.width, self.height, self.fx, self.fy) <= 0:
            raise KfvoError(f'expected positive sizes and focal lengths, came {self.width}x'
                            f'{self.height} fx={self.fx} fy={self.fy}; is it calibrated?')
        if not 0.0 <= self.readout_s < MAX_READOUT:
            raise KfvoError(f'expected a readout time of 0 to {MAX_READOUT} s, came '
                            f'readout_s={self.readout_s}')
        object.__setattr__(self, 'distortion_model', model)
        object.__setattr__(self, 'distortion', coefficients)
        self._check_matrix()
        self._check_distortion()

    def _check_matrix(self) -> None:
        """Raise KfvoError for numbers that no camera has, such as those of a misplaced matrix."""
        side = max(self.width, self.height)
        least, most = (share * side for share in FOCAL_RANGE)
        if not (least <= self.fx <= most and least <= self.fy <= most
                and 1.0 / MAX_PIXEL_ASPECT <= self.fx / self.fy <= MAX_PIXEL_ASPECT):
            raise KfvoError(f'expected focal lengths of {least:.6g} to {most:.6g} px for '
                            f'{self.width}x{self.height} images, and fx like fy; came '
                            f'fx={self.fx} fy={self.fy}; is it calibrated, in pixels?')
        for centre, size, focal in ((self.cx, self.width, self.fx),
                                    (self.cy, self.height, self.fy)):
            reach = MAX_CENTRE_OFFSET * focal
            if not -reach <= centre <= size + reach:
                raise KfvoError(f'expected a principal point in or near the {self.width}x'
                                f'{self.height} image, came cx={self.cx} cy={self.cy}; is it '
                                'calibrated?')

    def _check_distortion(self) -> None:
        """Raise KfvoError for coefficients that no lens has, some of which have no inverse."""
        if self.distortion_model == 'none':
            return
        radius = 0.25 * max(self.width, self.height) / max(self.fx, self.fy)
        shift = _largest_shift(self.distortion_model, self.distortion, radius)
        if not shift <= MAX_SHIFT:  # NaN neither
            raise KfvoError('expected the distortion of a lens, came '
                            f'{self.distortion_model} {list(self.distortion)}, which shifts '
                            f'pixels by {shift:.3g} times their distance from the axis; is it '
                            'calibrated?')

    @property
    def matrix(self) -> np.ndarray:
        """Intrinsic matrix K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def projection(self) -> np.ndarray:
        """Projection matrix P (3, 4) of a monocular camera: [K 0]."""
        return np.column_stack([self.matrix, np.zeros(3)])

    @property
    def ros_distortion(self) -> tuple[str, tuple[float, ...]]:
        """Model and coefficients for CameraInfo, which has no name for zero distortion."""
        none = ('plumb_bob', (0.0,) * 5)
        return none if self.distortion_model == 'none' else (self.distortion_model,
                                                             self.distortion)

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Return undistorted normalised coordinates (N, 2) of pixels (N, 2).

        Rays beyond MAX_VIEW_ANGLE, and pixels where the model has no inverse, are NaN.
        """
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        if self.distortion_model == 'none' or len(pixels) == 0:
            return (pixels[:, 0] - (self.cx, self.cy)) / (self.fx, self.fy)
        coefficients = np.array(self.distortion)
        if self.distortion_model == 'equidistant':
            points = cv2.fisheye.undistortPoints(pixels, self.matrix, coefficients)[:, 0]
        else:
            points = self._undistort_polynomial(pixels[:, 0])
        usable = np.isfinite(points).all(axis=1)
        usable &= np.hypot(points[:, 0], points[:, 1]) < math.tan(MAX_VIEW_ANGLE)
        reprojected = self.distort(np.where(usable[:, None], points, 0.0))
        usable &= np.linalg.norm(reprojected - pixels[:, 0], axis=1) < 1e-3
        return np.where(usable[:, None], points, np.nan)

    def _undistort_polynomial(self, pixels: np.ndarray) -> np.ndarray:
        """Return normalised coordinates (N, 2) of pixels (N, 2) by Newton's method.

        OpenCV's fixed-point iteration stops early or diverges towards the edge of a wide-angle
        image. Beyond the turning point of the polynomial, where two rays share one pixel, the
        result is NaN.
        """
        points, zero = (pixels - (self.cx, self.cy)) / (self.fx, self.fy), np.zeros(3)
        with np.errstate(all='ignore'):
            for _ in range(NEWTON_STEPS):
                rays = np.column_stack([points, np.ones(len(points))])
                projected, jacobian = cv2.projectPoints(rays, zero, zero, self.matrix,
                                                        np.array(self.distortion))
                # At depth 1 the derivative by the camera's translation is that by the point.
                (a, b), (c, d) = np.moveaxis(jacobian.reshape(-1, 2, jacobian.shape[1]), 0,
                                             -1)[:, 3:5]
                u, v = (pixels - projected[:, 0]).T
                determinant = a * d - b * c
                step = np.column_stack([d * u - b * v, a * v - c * u]) / determinant[:, None]
                points = points + step
                if not np.any(np.abs(step) > CONVERGED):
                    break
        return np.where(determinant[:, None] > 0.0, points, np.nan)

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of undistorted normalised coordinates (N, 2)."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if self.distortion_model == 'none' or len(points) == 0:
            return points * (self.fx, self.fy) + (self.cx, self.cy)
        return _project(points, self.matrix, self.distortion_model, self.distortion)

    def scaled(self, width: int, height: int) -> Camera:
        """Return the camera of the image resized to width x height.

        Raises KfvoError when the aspect ratio differs by more than a pixel: that is a crop.
        """
        if (width, height) == (self.width, self.height):
            return self
        factor = width / self.width
        if abs(height - self.height * factor) > 1.0:
            raise KfvoError(f'the calibration is for {self.width}x{self.height} images, '
                            f'{width}x{height} came; give the calibration of these images')
        return replace(self, width=width, height=height, fx=self.fx * factor,
                       fy=self.fy * factor, cx=(self.cx + 0.5) * factor - 0.5,
                       cy=(self.cy + 0.5) * factor - 0.5)

    def miscalibrated(self, focal: float, radial: float) -> Camera:
        """Return the camera with calibration errors, as training augments it.

        `focal` is the relative error of fx and fy; `radial` is added to the first distortion
        coefficient, so it is the relative radial error at one focal length from the axis.
        """
        model, coefficients = self.distortion_model, self.distortion
        if model == 'none':
            model, coefficients = 'plumb_bob', (0.0,) * 5
        return replace(self, fx=self.fx * (1.0 + focal), fy=self.fy * (1.0 + focal),
                       distortion_model=model,
                       distortion=(coefficients[0] + radial, *coefficients[1:]))

    def cropped(self, x: int, y: int, width: int, height: int) -> Camera:
        """Return the camera of a region of the image whose first pixel is (x, y)."""
        return replace(self, width=width, height=height, cx=self.cx - x, cy=self.cy - y)

    def binned(self, across: int, down: int) -> Camera:
        """Return the camera of the image binned by `across` x `down` pixels."""
        return replace(self, width=self.width // across, height=self.height // down,
                       fx=self.fx / across, fy=self.fy / down,
                       cx=(self.cx + 0.5) / across - 0.5, cy=(self.cy + 0.5) / down - 0.5)


def guess_camera(width: int, height: int) -> Camera:
    """Return a guessed camera of an uncalibrated image: a horizontal field of view of 60 deg."""
    focal = 0.5 * width / math.tan(math.radians(30.0))
    return Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1),
                  guessed=True)


def _project(points: np.ndarray, K: np.ndarray, model: str, distortion: tuple[float, ...]
             ) -> np.ndarray:
    """Return the pixels (N, 2) of normalised coordinates (N, 2) by one of the models."""
    coefficients = np.array(distortion)
    if model == 'equidistant':
        return cv2.fisheye.distortPoints(points[:, None], K, coefficients)[:, 0]
    rays = np.column_stack([points, np.ones(len(points))])
    zero = np.zeros(3)
    return cv2.projectPoints(rays, zero, zero, K, coefficients)[0][:, 0]


@functools.lru_cache(maxsize=64)  # a camera is made for each message with the calibration
def _largest_shift(model: str, distortion: tuple[float, ...], radius: float) -> float:
    """Return the largest shift by distortion at a radius from the axis, in units of it."""
    rays = radius * np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
    with np.errstate(all='ignore'):
        shifts = _project(rays, np.eye(3), model, distortion) - rays
        return float(np.linalg.norm(shifts, axis=1).max()) / radius


def plain_name(name: str) -> str:
    """Return a name of a calibration without case, spaces, dashes and underscores."""
    return re.sub(r'[\s_-]', '', name.lower())


def _distortion(name: str, coefficients: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """Return the ROS name of a model and as many coefficients as it has; raises KfvoError.

    Without a name it is plumb_bob, as in ROS. Surplus zeros are left out.
    """
    plain = plain_name(name)
    model = MODEL_SYNONYMS.get(plain) if plain else PLUMB_BOB
    if model is None:
        raise KfvoError(f'unknown distortion model {name!r}; expected one of '
                        f'{", ".join(sorted(DISTORTION_SIZES))}')
    if not coefficients or (model != 'equidistant' and not any(coefficients)):
        return 'none', ()
    sizes = DISTORTION_SIZES[model]
    used = _without_zeros(coefficients, sizes)
    if used is None and model in (PLUMB_BOB, RATIONAL):
        sizes = POLYNOMIAL_SIZES
        used = _without_zeros(coefficients, sizes)
    if used is None:
        raise KfvoError(f'{model} takes {" or ".join(map(str, sizes))} distortion coefficients, '
                        f'{len(coefficients)} came')
    if model == 'equidistant':
        return model, used
    if len(used) == 4:
        used += (0.0,)  # ROS always stores a k3
    return PLUMB_BOB if len(used) == 5 else RATIONAL, used


def _without_zeros(coefficients: tuple[float, ...], sizes: tuple[int, ...]
                   ) -> tuple[float, ...] | None:
    """Return the coefficients without as many zeros at the end as leave one of the `sizes`."""
    while coefficients and len(coefficients) not in sizes and coefficients[-1] == 0.0:
        coefficients = coefficients[:-1]
    return coefficients if len(coefficients) in sizes else None
