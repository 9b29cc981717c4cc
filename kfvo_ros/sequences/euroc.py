# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""EuRoC MAV dataset in the ASL layout: mav0/cam0 with data.csv and sensor.yaml.

Source: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import (
    Calibration,
    GroundTruth,
    SequenceKind,
    SequenceSettings,
)
from kfvo_ros.sequences.image_folder import ImageListSequence
from kfvo_ros.trajectory import Trajectory
from kfvo_ros.utils.files import parse_pose, read_rows, read_yaml


def open_euroc(path: Path, settings: SequenceSettings) -> ImageListSequence:
    """Open the left camera of a sequence; `path` is mav0 or its parent."""
    root = path / 'mav0' if (path / 'mav0').is_dir() else path
    folder = root.parent if root.name == 'mav0' else root
    sensor_file = root / 'cam0' / 'sensor.yaml'
    images = read_rows(root / 'cam0' / 'data.csv', 'timestamp [ns],filename', _parse_image)
    calibration = Calibration(settings.camera, folder, partial(_read_camera, sensor_file))
    return ImageListSequence(folder.name, root / 'cam0' / 'data', images, calibration,
                             partial(_read_ground_truth, root, sensor_file),
                             partial(_read_extrinsics, sensor_file))


def _matches(path: Path) -> bool:
    return any((root / 'cam0' / 'data.csv').is_file() for root in (path, path / 'mav0'))


KIND = SequenceKind('euroc', 'EuRoC: a folder with mav0/cam0/data.csv', _matches, open_euroc)


def _parse_image(line: str) -> tuple[int, str]:
    stamp_ns, file_name = line.split(',')[:2]
    return int(stamp_ns), file_name.strip()


def _read_sensor(path: Path) -> dict[str, Any]:
    sensor = read_yaml(path)
    if not isinstance(sensor, dict):
        raise KfvoError(f'{path}: expected the keys of an EuRoC sensor, found {sensor!r:.80}')
    return sensor


def _read_camera(sensor_file: Path, width: int, height: int) -> Camera | None:
    if not sensor_file.is_file():
        return None
    sensor = _read_sensor(sensor_file)
    try:
        width, height = map(int, sensor['resolution'])
        fx, fy, cx, cy = map(float, sensor['intrinsics'])
        return Camera(width, height, fx, fy, cx, cy, str(sensor['distortion_model']),
                      tuple(map(float, sensor['distortion_coefficients'])))
    except (KeyError, TypeError, ValueError, OverflowError, KfvoError) as error:
        raise KfvoError(f'{sensor_file}: expected resolution [2], intrinsics [4], '
                        'distortion_model and distortion_coefficients; '
                        f'problem: {error}') from error


def _read_ground_truth(root: Path, sensor_file: Path) -> GroundTruth | None:
    """Return T_world_camera: the file's T_world_body (quaternion w first) times T_BS."""
    path = root / 'state_groundtruth_estimate0' / 'data.csv'
    if not path.is_file():
        return None
    rows = read_rows(path, 'timestamp [ns], p x y z, q w x y z, ...', _parse_pose)
    values = np.array([row for _, row in rows]).reshape(-1, 7)
    T_world_body = geometry.transform_from_xyz_quat(values[:, [0, 1, 2, 4, 5, 6, 3]])
    trajectory = Trajectory(np.array([stamp_ns for stamp_ns, _ in rows], dtype=np.int64),
                            T_world_body)
    T_body_camera = _read_extrinsics(sensor_file)
    if T_body_camera is None:
        raise KfvoError(f'{sensor_file}: expected T_BS with 16 numbers under data')
    return GroundTruth(trajectory.right_multiplied(T_body_camera))


def _read_extrinsics(sensor_file: Path) -> np.ndarray | None:
    """Return T_body_camera, which EuRoC names T_BS, None where there is none."""
    if not sensor_file.is_file():
        return None
    extrinsics = _read_sensor(sensor_file).get('T_BS')
    if not isinstance(extrinsics, dict):
        return None
    return geometry.as_rigid_transform(extrinsics.get('data'), f'{sensor_file}, T_BS')


def _parse_pose(line: str) -> tuple[int, list[float]]:
    stamp_ns, *fields = line.split(',')
    return int(stamp_ns), parse_pose(fields[:7])
