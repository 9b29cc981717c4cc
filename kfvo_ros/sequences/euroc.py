# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""EuRoC MAV dataset in the ASL layout, which TUM VI has too: mav0/cam0 with data.csv.

Source: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016; Schubert et al.,
"The TUM VI benchmark for evaluating visual-inertial odometry", IROS 2018.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, quoted
from kfvo_ros.sequences.base import (
    BODY_FRAME,
    Calibration,
    GroundTruth,
    SequenceKind,
    SequenceSettings,
)
from kfvo_ros.sequences.calibration import calibration_from_mapping
from kfvo_ros.sequences.image_folder import ImageListSequence
from kfvo_ros.trajectory import parse_nanoseconds, read_pose_table
from kfvo_ros.utils.files import read_rows, read_yaml

GROUND_TRUTH_FOLDERS = ('state_groundtruth_estimate0', 'mocap0')
"""Poses of the body by EuRoC and by TUM VI, whose mocap0 was aligned with the IMU."""


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


KIND = SequenceKind('euroc', 'EuRoC or TUM VI: mav0/cam0/data.csv', _matches, open_euroc)


def _parse_image(line: str) -> tuple[int, str]:
    stamp_ns, file_name = line.split(',')[:2]
    return int(stamp_ns), file_name.strip()


def _read_sensor(path: Path) -> dict[str, Any]:
    """Return the keys of a sensor.yaml, none where there is no file; raises KfvoError."""
    sensor = read_yaml(path) if os.path.lexists(path) else {}
    if not isinstance(sensor, dict):
        raise KfvoError(f'{path}: expected the keys of an EuRoC sensor, found {quoted(sensor)}')
    return sensor


def _read_camera(sensor_file: Path, width: int, height: int) -> Camera | None:
    sensor = _read_sensor(sensor_file)
    return calibration_from_mapping(sensor, str(sensor_file)).camera() if sensor else None


def _read_ground_truth(root: Path, sensor_file: Path) -> GroundTruth | None:
    """Return T_world_camera: the file's T_world_body (quaternion w first) times T_BS.

    Without T_BS it is the trajectory of the body.
    """
    path = next((root / name / 'data.csv' for name in GROUND_TRUTH_FOLDERS
                 if (root / name / 'data.csv').is_file()), None)
    if path is None:
        return None
    trajectory = read_pose_table(path, parse_nanoseconds, scalar_first=True)
    T_body_camera = _read_extrinsics(sensor_file)
    if T_body_camera is None or not trajectory.has_rotation:
        return GroundTruth(trajectory, BODY_FRAME)
    return GroundTruth(trajectory.right_multiplied(T_body_camera))


def _read_extrinsics(sensor_file: Path) -> np.ndarray | None:
    """Return T_body_camera, which EuRoC names T_BS, None where there is none."""
    extrinsics = _read_sensor(sensor_file).get('T_BS')
    if not isinstance(extrinsics, dict):
        return None
    return geometry.as_rigid_transform(extrinsics.get('data'), f'{sensor_file}, T_BS')
