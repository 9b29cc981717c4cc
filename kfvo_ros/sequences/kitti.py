# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""KITTI odometry dataset: root/sequences/NN with times.txt and calib.txt, root/poses/NN.txt.

Source: Geiger, Lenz and Urtasun, "Are we ready for autonomous driving?", CVPR 2012, and the
development kit's readme.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Calibration, GroundTruth, SequenceKind, SequenceSettings
from kfvo_ros.sequences.image_folder import IMAGE_SUFFIXES, ImageListSequence
from kfvo_ros.trajectory import parse_stamp_ns, read_kitti_poses
from kfvo_ros.utils.files import parse_floats, read_rows

IMAGE_FOLDERS = {'image_0': 'P0', 'image_2': 'P2'}
"""Image folders in order of preference (left grey, left colour), and their row of calib.txt."""


def open_kitti(path: Path, settings: SequenceSettings) -> ImageListSequence:
    """Open the left grey camera of a sequence, or the left colour camera without a grey one."""
    stamps_ns = read_rows(path / 'times.txt', 'seconds', parse_stamp_ns)
    folder = next((path / name for name in IMAGE_FOLDERS if (path / name).is_dir()), None)
    if folder is None:
        raise KfvoError(f'{path}: expected a folder {" or ".join(IMAGE_FOLDERS)}, found neither')
    suffix = _image_suffix(folder)
    images = [(stamp_ns, f'{index:06d}{suffix}') for index, stamp_ns in enumerate(stamps_ns)]
    read_camera = partial(_read_camera, path / 'calib.txt', IMAGE_FOLDERS[folder.name])
    return ImageListSequence(f'kitti/{path.name}', folder, images,
                             Calibration(settings.camera, path, read_camera),
                             partial(_read_ground_truth, path, folder.name, stamps_ns))


def _matches(path: Path) -> bool:
    return (path / 'times.txt').is_file() and any((path / n).is_dir() for n in IMAGE_FOLDERS)


KIND = SequenceKind('kitti', 'KITTI: root/sequences/NN with times.txt and image_0 or image_2',
                    _matches, open_kitti)


def _image_suffix(folder: Path) -> str:
    """Return the suffix of frame 0's image file, .png where there is none."""
    return next((suffix for suffix in sorted(IMAGE_SUFFIXES)
                 if (folder / f'000000{suffix}').is_file()), '.png')


def _read_projection(path: Path, key: str) -> np.ndarray:
    """Return the projection P (3, 4) of one camera, from camera 0's frame to pixels."""
    for name, numbers in read_rows(path, 'P0: 12 numbers', _parse_calibration):
        if name == key:
            return np.array(numbers).reshape(3, 4)
    raise KfvoError(f'{path}: expected a line "{key}: ...", found none')


def _parse_calibration(line: str) -> tuple[str, list[float]]:
    key, *fields = line.split()
    return key.rstrip(':'), parse_floats(fields, 12)


def _read_camera(path: Path, key: str, width: int, height: int) -> Camera | None:
    if not path.is_file():
        return None
    P = _read_projection(path, key)
    try:
        return Camera(width, height, float(P[0, 0]), float(P[1, 1]), float(P[0, 2]),
                      float(P[1, 2]))
    except KfvoError as error:
        raise KfvoError(f'{path}: {error}') from error


def _read_ground_truth(path: Path, folder: str, stamps_ns: list[int]) -> GroundTruth | None:
    """Return T_world_camera: the file's T_world_camera0, for image_2 shifted by P2's offset."""
    poses = path.parent.parent / 'poses' / f'{path.name}.txt'
    if not poses.is_file():
        return None
    trajectory = read_kitti_poses(poses, np.array(stamps_ns, dtype=np.int64))
    if folder == 'image_0':
        return GroundTruth(trajectory)
    P = _read_projection(path / 'calib.txt', IMAGE_FOLDERS[folder])
    offset = -np.linalg.solve(P[:, :3], P[:, 3])
    return GroundTruth(trajectory.right_multiplied(geometry.make_transform(np.eye(3), offset)))
