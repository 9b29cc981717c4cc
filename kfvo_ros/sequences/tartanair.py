# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TartanAir dataset, V1 and V2: .../P000 with images and poses of the left camera.

Source: Wang et al., "TartanAir: a dataset to push the limits of visual SLAM", IROS 2020, and
the data pages of tartanair_tools and tartanairpy.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.sequences.base import Calibration, GroundTruth, SequenceKind, SequenceSettings
from kfvo_ros.sequences.image_folder import ImageListSequence, list_images, stamps_at_rate
from kfvo_ros.trajectory import Trajectory, read_numbered_rows

CAMERAS = {'left': Camera(640, 480, 320.0, 320.0, 320.0, 240.0),
           'lcam_front': Camera(640, 640, 320.0, 320.0, 320.0, 320.0)}
"""The cameras of all sequences of V1 and V2, by the end of their folders' names."""
R_NED_OPTICAL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""The dataset's camera frame has x forward and z down, an optical frame z forward and y down."""


def open_tartanair(path: Path, settings: SequenceSettings) -> ImageListSequence:
    """Open the left camera of a trajectory folder, stamped at the rate of the settings."""
    name = _camera_name(path) or next(iter(CAMERAS))
    folder = path / f'image_{name}'
    stamp_at = stamps_at_rate(settings.rate)
    images = [(stamp_at(index), file) for index, file in enumerate(list_images(folder))]
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in images], dtype=np.int64)
    return ImageListSequence('/'.join(path.parts[-3:]), folder, images,
                             Calibration(settings.camera, path,
                                         lambda width, height: CAMERAS[name]),
                             partial(_read_ground_truth, path / f'pose_{name}.txt', stamps_ns))


def _camera_name(path: Path) -> str | None:
    return next((name for name in CAMERAS if (path / f'image_{name}').is_dir()
                 and (path / f'pose_{name}.txt').is_file()), None)


def _matches(path: Path) -> bool:
    return _camera_name(path) is not None


KIND = SequenceKind('tartanair', 'TartanAir: image_left or image_lcam_front, with its poses',
                    _matches, open_tartanair)


def _read_ground_truth(path: Path, stamps_ns: np.ndarray) -> GroundTruth | None:
    """Return T_world_camera with optical axes; the world frame stays NED."""
    if not path.is_file():
        return None
    kept_ns, values = read_numbered_rows(path, 7, 'tx ty tz qx qy qz qw', stamps_ns)
    rotations = geometry.rotation_from_quat_xyzw(values[:, 3:]) @ R_NED_OPTICAL
    return GroundTruth(Trajectory(kept_ns, geometry.make_transform(rotations, values[:, :3])))
