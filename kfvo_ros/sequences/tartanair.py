# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TartanAir V1 dataset: .../P000 with image_left and pose_left.txt.

Source: Wang et al., "TartanAir: a dataset to push the limits of visual SLAM", IROS 2020, and
the data page of tartanair_tools.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Calibration, GroundTruth, SequenceKind, SequenceSettings
from kfvo_ros.sequences.image_folder import ImageListSequence, list_images, stamps_at_rate
from kfvo_ros.trajectory import Trajectory
from kfvo_ros.utils.files import parse_pose, read_rows

CAMERA = Camera(640, 480, 320.0, 320.0, 320.0, 240.0)
"""The camera of all sequences."""
R_NED_OPTICAL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""The dataset's camera frame has x forward and z down, an optical frame z forward and y down."""


def open_tartanair(path: Path, settings: SequenceSettings) -> ImageListSequence:
    """Open the left camera of a trajectory folder, stamped at the rate of the settings."""
    folder = path / 'image_left'
    stamp_at = stamps_at_rate(settings.rate)
    images = [(stamp_at(index), name) for index, name in enumerate(list_images(folder))]
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in images], dtype=np.int64)
    return ImageListSequence('/'.join(path.parts[-3:]), folder, images,
                             Calibration(settings.camera, path, lambda width, height: CAMERA),
                             partial(_read_ground_truth, path / 'pose_left.txt', stamps_ns))


def _matches(path: Path) -> bool:
    return (path / 'image_left').is_dir() and (path / 'pose_left.txt').is_file()


KIND = SequenceKind('tartanair', 'TartanAir V1: .../P000 with image_left and pose_left.txt',
                    _matches, open_tartanair)


def _read_ground_truth(path: Path, stamps_ns: np.ndarray) -> GroundTruth | None:
    """Return T_world_camera with optical axes; the world frame stays NED."""
    if not path.is_file():
        return None
    rows = read_rows(path, 'tx ty tz qx qy qz qw', lambda line: parse_pose(line.split()))
    if len(rows) != len(stamps_ns):
        raise KfvoError(f'{path} holds {len(rows)} poses for {len(stamps_ns)} images; '
                        'expected one line per image')
    values = np.array(rows).reshape(-1, 7)
    rotations = geometry.rotation_from_quat_xyzw(values[:, 3:]) @ R_NED_OPTICAL
    return GroundTruth(Trajectory(stamps_ns, geometry.make_transform(rotations, values[:, :3])))
