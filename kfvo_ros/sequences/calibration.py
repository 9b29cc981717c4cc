# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Calibrations of a camera, for its raw and its rectified images, and their files.

Read are the files of ROS' camera_calibration (camera_info.yaml, ost.yaml, ost.txt), OpenCV's
FileStorage, kalibr's camchain, EuRoC's sensor.yaml, and what ``ros2 topic echo`` prints of a
CameraInfo. Written is a camera_info.yaml.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from kfvo_ros.camera import MODEL_SYNONYMS, Camera, plain_name
from kfvo_ros.errors import KfvoError, quoted, reason_of
from kfvo_ros.utils.files import MALFORMED_YAML, parse_yaml, read_text

MAX_SKEW = 0.01
"""Largest skew of an intrinsic matrix, in focal lengths; it is neglected."""
ALIASES = {alias: name for name, aliases in {
    'image_width': 'imagewidth width', 'image_height': 'imageheight height',
    'resolution': 'resolution imagesize', 'intrinsics': 'intrinsics',
    'camera_matrix': 'cameramatrix k cameramat intrinsicmatrix',
    'distortion_coefficients': 'distortioncoefficients d distortioncoeffs distcoeffs distcoeff '
                               'distortion',
    'projection_matrix': 'projectionmatrix p projection', 'camera_model': 'cameramodel',
    'distortion_model': 'distortionmodel distmodel', 'fisheye_model': 'fisheyemodel',
    'readout_s': 'readouts'}.items() for alias in aliases.split()}
"""Keys of all forms, as `plain_name` writes them -> their names here."""
EXPECTED = ('expected a camera calibration of ROS, OpenCV or kalibr, with image_width and '
            'image_height (or resolution), camera_matrix (or intrinsics), distortion_model and '
            'distortion_coefficients')
_INI_SECTION = re.compile(r'^\s*\[image\]\s*$', re.MULTILINE)
_DOCUMENT_START = re.compile(r'^---.*$', re.MULTILINE)
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """The numbers of a calibration as they came, which are checked when a camera is made.

    ``K`` (9 numbers) and ``D`` belong to raw images, ``P`` (12 numbers) to rectified ones.
    Errors name the ``source``.
    """

    width: int
    height: int
    K: Any
    D: Any
    P: Any = ()
    distortion_model: str = ''
    readout_s: float = 0.0
    source: str = ''

    def matrix(self, rectified: bool = False) -> np.ndarray:
        """Return the intrinsic matrix (3, 3) of raw or rectified images; raises KfvoError.

        That of rectified images is in P; it is K where P is zero or missing.
        """
        with _calibration_errors(self.source):
            if rectified and np.any(_numbers(self.P, None)):
                return _numbers(self.P, 12, 'projection_matrix').reshape(3, 4)[:, :3]
            return _numbers(self.K, 9, 'camera_matrix').reshape(3, 3)

    def camera(self, rectified: bool = False) -> Camera:
        """Return the camera of raw images, or that of rectified ones, without distortion.

        Raises KfvoError for numbers that are no calibration.
        """
        matrix = self.matrix(rectified)
        with _calibration_errors(self.source):
            _check_form(matrix)
            fx, fy, cx, cy = map(float, matrix[[0, 1, 0, 1], [0, 1, 2, 2]])
            distortion = ('none', ()) if rectified else (
                self.distortion_model, tuple(_numbers(self.D, None).tolist()))
            return Camera(self.width, self.height, fx, fy, cx, cy, *distortion,
                          readout_s=self.readout_s)


def read_calibration(path: Path) -> CameraCalibration:
    """Read a calibration file; raises KfvoError naming the file and what is missing in it.

    The extra key ``readout_s`` is the readout time of a rolling shutter [s].
    """
    try:
        text = read_text(path)
        document = _parse_ini(text) if _INI_SECTION.search(text) else \
            parse_yaml(_first_document(text))
    except (OSError, *MALFORMED_YAML) as error:
        raise KfvoError(f'cannot read the calibration {path}: {reason_of(error)}') from error
    return calibration_from_mapping(document, str(path))


def read_camera_info(path: Path, rectified: bool = False) -> Camera:
    """Return the camera of a calibration file, for raw or rectified images; raises KfvoError."""
    return read_calibration(path).camera(rectified)


def calibration_from_mapping(document: Any, source: str) -> CameraCalibration:
    """Return the calibration in the content of a file; raises KfvoError.

    Of several cameras, as a camchain has them, it is the first.
    """
    with _calibration_errors(source):
        entries = _entries(document)
        if 'camera_matrix' not in entries and 'intrinsics' not in entries:
            entries = _first_camera(document, source)
        width, height = map(int, entries['resolution'] if 'resolution' in entries else (
            entries['image_width'], entries['image_height']))
        K = entries['camera_matrix'] if 'camera_matrix' in entries else \
            _matrix_of(entries['intrinsics'])
        model = _distortion_model(entries)
        D = entries.get('distortion_coefficients', ()) if model == 'none' else \
            entries['distortion_coefficients']
        if not model and np.any(_numbers(D, None)):
            _log.warning('%s names no distortion_model: plumb_bob is assumed, as in ROS', source)
        return CameraCalibration(width, height, K, D, entries.get('projection_matrix', ()),
                                 model, float(entries.get('readout_s', 0.0)), source)


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


def _check_form(matrix: np.ndarray) -> None:
    """Raise KfvoError for an intrinsic matrix (3, 3) with numbers in the wrong places."""
    (fx, skew, _), (below, _, _), last = matrix.tolist()
    is_homogeneous = all(abs(value - one) <= 1e-3 for value, one in zip(last, (0.0, 0.0, 1.0)))
    if not is_homogeneous or abs(skew) > MAX_SKEW * abs(fx) or abs(below) > 1e-3:
        numbers = ' '.join(f'{value:.6g}' for value in matrix.ravel())
        raise KfvoError(f'expected a camera matrix fx 0 cx 0 fy cy 0 0 1, came {numbers}; is it '
                        'calibrated?')


def _numbers(value: Any, size: int | None, name: str = '') -> np.ndarray:
    """Return the numbers (N,) of a list, of a list of rows, or of ``{data: [...]}``."""
    data = value['data'] if isinstance(value, dict) else value
    numbers = np.asarray(() if data is None else data, dtype=np.float64).ravel()
    if size is not None and len(numbers) != size:
        raise ValueError(f'{name} holds {len(numbers)} numbers, expected {size}')
    return numbers


def _matrix_of(intrinsics: Any) -> list[float]:
    """Return K of the four numbers that kalibr and EuRoC write."""
    fx, fy, cx, cy = _numbers(intrinsics, 4, 'intrinsics')
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def _distortion_model(entries: dict[str, Any]) -> str:
    """Return the name of the distortion model, empty where none is named.

    Some files have it under camera_model, where kalibr has pinhole and models of wide lenses.
    """
    named = str(entries.get('distortion_model')
                or ('equidistant' if entries.get('fisheye_model') else ''))
    projection = str(entries.get('camera_model') or 'pinhole')
    if not named:
        return '' if projection == 'pinhole' else projection
    if plain_name(projection) not in MODEL_SYNONYMS:
        raise KfvoError(f'expected camera_model pinhole, came {projection!r}; calibrate with '
                        'another model')
    return named


def _entries(document: Any) -> dict[str, Any]:
    """Return what the keys of a mapping hold, by their names here; of equal names the first."""
    if not isinstance(document, dict):
        raise ValueError(f'found {quoted(document)[:80]}')
    entries: dict[str, Any] = {}
    for key, value in document.items():
        plain = plain_name(str(key))
        entries.setdefault(ALIASES.get(plain, plain), value)
    return entries


def _first_camera(document: dict[str, Any], source: str) -> dict[str, Any]:
    """Return the entries of the first camera of a mapping of cameras, with a warning if several.

    Without one they are those of the mapping itself.
    """
    cameras = {name: entries for name, value in document.items() if isinstance(value, dict)
               for entries in [_entries(value)] if entries.keys() & {'camera_matrix',
                                                                     'intrinsics'}}
    if len(cameras) > 1:
        first, *others = map(str, cameras)
        _log.warning('%s: using the calibration of %s; others are: %s', source, first,
                     ', '.join(others))
    return next(iter(cameras.values()), _entries(document))


def _first_document(text: str) -> str:
    """Return the first YAML document of a text; a topic that is echoed prints many."""
    return next((part for part in _DOCUMENT_START.split(text)
                 if any(line.strip() and not line.startswith(('%', '#'))
                        for line in part.splitlines())), '')


def _parse_ini(text: str) -> dict[str, Any]:
    """Return the entries of an ost.txt: names, each followed by lines of numbers."""
    entries: dict[str, Any] = {'distortion_model': 'plumb_bob'}
    values: list[float] = []
    for line in filter(None, (line.strip() for line in text.splitlines())):
        if line.startswith(('#', ';', '[')):
            continue
        try:
            values += map(float, line.split())
        except ValueError:
            values = []
            entries.setdefault(line, values)
    return {name: numbers[0] if name in ('width', 'height') else numbers
            for name, numbers in entries.items()}


@contextmanager
def _calibration_errors(source: str) -> Iterator[None]:
    """Turn what malformed numbers and missing keys raise into a KfvoError; name the source."""
    prefix = f'{source}: ' if source else ''
    try:
        yield
    except KfvoError as error:
        raise KfvoError(f'{prefix}{error}') from error
    except KeyError as error:
        raise KfvoError(f'{prefix}{EXPECTED}; {error.args[0]} is missing') from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise KfvoError(f'{prefix}{EXPECTED}; problem: {reason_of(error)}') from error
