# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Camera intrinsics and distortion, and their ROS calibration file."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.utils.files import read_yaml

DISTORTION_SIZES = {'none': (0,), 'plumb_bob': (4, 5), 'rational_polynomial': (8,),
                    'equidistant': (4,)}
"""Distortion models by ROS name, with their possible numbers of coefficients."""
MODEL_SYNONYMS = {'': 'none', 'none': 'none', 'pinhole': 'none', 'plumb_bob': 'plumb_bob',
                  'radtan': 'plumb_bob', 'radial-tangential': 'plumb_bob',
                  'rational_polynomial': 'rational_polynomial', 'equidistant': 'equidistant',
                  'fisheye': 'equidistant'}
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
        model = MODEL_SYNONYMS.get(self.distortion_model.strip().lower())
        if model is None:
            raise KfvoError(f'unknown distortion model {self.distortion_model!r}; expected one '
                            f'of {", ".join(sorted(DISTORTION_SIZES))}')
        coefficients = tuple(float(value) for value in self.distortion)
        if model != 'equidistant' and not any(coefficients):
            model, coefficients = 'none', ()
        if model == 'plumb_bob' and len(coefficients) == 4:
            coefficients += (0.0,)  # ROS always stores a k3
        if len(coefficients) not in DISTORTION_SIZES[model]:
            raise KfvoError(f'{model} takes {DISTORTION_SIZES[model]} distortion coefficients, '
                            f'{len(coefficients)} came')
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
        coefficients = np.array(self.distortion)
        if self.distortion_model == 'equidistant':
            return cv2.fisheye.distortPoints(points[:, None], self.matrix, coefficients)[:, 0]
        rays = np.column_stack([points, np.ones(len(points))])
        zero = np.zeros(3)
        return cv2.projectPoints(rays, zero, zero, self.matrix, coefficients)[0][:, 0]

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


def read_camera_info(path: Path) -> Camera:
    """Read a calibration file in the format of ROS' camera_calibration.

    The optional extra key ``readout_s`` is the readout time of a rolling shutter [s]. Raises
    KfvoError naming the file and the key that is missing or wrong.
    """
    document = read_yaml(path, 'the calibration ')
    try:
        fx, _, cx, _, fy, cy = _matrix(document, 'camera_matrix', 9)[:6]
        return Camera(int(document['image_width']), int(document['image_height']), fx, fy, cx,
                      cy, str(document.get('distortion_model', 'none')),
                      _matrix(document, 'distortion_coefficients', None),
                      readout_s=float(document.get('readout_s', 0.0)))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise KfvoError(f'{path}: expected a ROS camera calibration with image_width, '
                        f'image_height, camera_matrix, distortion_model and '
                        f'distortion_coefficients; problem: {error!r}') from error
    except KfvoError as error:
        raise KfvoError(f'{path}: {error}') from error


def write_camera_info(path: Path, camera: Camera) -> None:
    """Write a calibration file for `read_camera_info`; raises KfvoError naming the file."""
    model, coefficients = camera.ros_distortion
    matrices = {'camera_matrix': camera.matrix, 'rectification_matrix': np.eye(3),
                'projection_matrix': camera.projection,
                'distortion_coefficients': np.array([coefficients])}
    document = {'image_width': camera.width, 'image_height': camera.height,
                'camera_name': 'camera', 'distortion_model': model,
                'readout_s': camera.readout_s,
                **{key: {'rows': matrix.shape[0], 'cols': matrix.shape[1],
                         'data': matrix.ravel().tolist()} for key, matrix in matrices.items()}}
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None)
    try:
        path.write_text(text, encoding='utf-8')
    except OSError as error:
        raise KfvoError(f'cannot write the calibration {path}: {reason_of(error)}') from error


def _matrix(document: dict[str, Any], key: str, size: int | None) -> tuple[float, ...]:
    """Return the numbers under ``key: {data: [...]}``."""
    data = tuple(float(value) for value in document[key]['data'])
    if size is not None and len(data) != size:
        raise ValueError(f'{key} holds {len(data)} numbers, expected {size}')
    return data
