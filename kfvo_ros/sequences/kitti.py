# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""KITTI: odometry sequences (root/sequences/NN, root/poses/NN.txt) and raw drives.

Source: Geiger, Lenz and Urtasun, "Are we ready for autonomous driving?", CVPR 2012, and the
development kits' readmes. SemanticKITTI has its poses of camera 0 in the sequence's folder.
"""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Calibration, GroundTruth, SequenceKind, SequenceSettings
from kfvo_ros.sequences.image_folder import ImageListSequence, list_images
from kfvo_ros.trajectory import parse_stamp_ns, read_kitti_poses
from kfvo_ros.utils.files import parse_floats, read_lines, read_rows

IMAGE_FOLDERS = {'image_0': 'P0', 'image_2': 'P2'}
"""Image folders in order of preference (left grey, left colour), and their row of calib.txt."""
RAW_FOLDERS = {'image_00': '00', 'image_02': '02'}
"""Those of a raw drive, and the end of their rows in calib_cam_to_cam.txt."""
OXTS = 'oxts'
_log = logging.getLogger(__name__)


def open_kitti(path: Path, settings: SequenceSettings) -> ImageListSequence:
    """Open the left grey camera of a sequence, or the left colour camera without a grey one."""
    if not (path / 'times.txt').exists() and _raw_folder(path) is not None:
        return _open_raw(path, settings)
    stamps_ns = read_rows(path / 'times.txt', 'seconds', parse_stamp_ns)
    folder = _first_folder(path, IMAGE_FOLDERS)
    if folder is None:
        raise KfvoError(f'{path}: expected a folder {" or ".join(IMAGE_FOLDERS)}, found neither')
    read_camera = partial(_read_camera, path / 'calib.txt', IMAGE_FOLDERS[folder.name])
    return ImageListSequence(f'kitti/{path.name}', folder, _stamped_images(folder, stamps_ns),
                             Calibration(settings.camera, path, read_camera),
                             partial(_read_ground_truth, path, folder.name, stamps_ns))


def _open_raw(path: Path, settings: SequenceSettings) -> ImageListSequence:
    """Open a raw drive, whose calibration is beside its folder; its GNSS poses are not read."""
    folder = _raw_folder(path)
    assert folder is not None
    stamps_ns = read_rows(folder / 'timestamps.txt', 'YYYY-MM-DD hh:mm:ss.sssssssss', _parse_date)
    read_camera = partial(_read_raw_camera, path.parent / 'calib_cam_to_cam.txt',
                          RAW_FOLDERS[folder.name])
    if (path / OXTS).is_dir():
        _log.warning('%s: the GNSS measurements in %s are not read: there is no ground truth',
                     path.name, OXTS)
    return ImageListSequence(f'kitti/{path.name}', folder / 'data',
                             _stamped_images(folder / 'data', stamps_ns),
                             Calibration(settings.camera, path, read_camera))


def _first_folder(path: Path, names: dict[str, str]) -> Path | None:
    return next((path / name for name in names if (path / name).is_dir()), None)


def _raw_folder(path: Path) -> Path | None:
    folder = _first_folder(path, RAW_FOLDERS)
    return folder if folder is not None and (folder / 'timestamps.txt').is_file() else None


def _matches(path: Path) -> bool:
    return _raw_folder(path) is not None or (
        (path / 'times.txt').is_file() and _first_folder(path, IMAGE_FOLDERS) is not None)


KIND = SequenceKind('kitti', 'KITTI: times.txt and image_0 or image_2, or a raw drive',
                    _matches, open_kitti)


def _stamped_images(folder: Path, stamps_ns: list[int]) -> list[tuple[int, str]]:
    """Return (stamp_ns, file name) of each stamp.

    The names of a complete folder are taken as they are, also if they start at another number.
    Where images are missing, names are counted from zero in the style of the first file.
    """
    names = [Path(name) for name in list_images(folder)]
    if names and all(name.stem.isdecimal() for name in names) and \
            int(names[-1].stem) - int(names[0].stem) + 1 == len(names) == len(stamps_ns):
        return [(stamp_ns, name.name) for stamp_ns, name in zip(stamps_ns, names)]
    first = next((name for name in names if name.stem.isdecimal()), Path('000000.png'))
    return [(stamp_ns, f'{index:0{len(first.stem)}d}{first.suffix}')
            for index, stamp_ns in enumerate(stamps_ns)]


def _parse_date(line: str) -> int:
    """Return nanoseconds since 1970 of a date and a time in UTC."""
    stamp = np.datetime64(line.replace(' ', 'T', 1), 'ns')
    if np.isnat(stamp):
        raise ValueError('expected a date')
    return int(stamp.astype(np.int64))


class _Row(NamedTuple):
    """A line ``key: numbers`` of a calibration file."""

    line: int
    fields: list[str]


def _read_rows_by_key(path: Path) -> dict[str, _Row]:
    """Return the rows of a calibration file by key; their numbers are not looked at."""
    rows: dict[str, _Row] = {}
    for number, line in read_lines(path):
        key, *fields = line.split()
        rows.setdefault(key.rstrip(':'), _Row(number, fields))
    return rows


def _numbers(path: Path, rows: dict[str, _Row], key: str, count: int) -> np.ndarray:
    """Return the numbers of one row; raises KfvoError naming the file and the line."""
    if key not in rows:
        raise KfvoError(f'{path}: expected a line "{key}: ...", found none')
    row = rows[key]
    try:
        return np.array(parse_floats(row.fields, count))
    except ValueError as error:
        raise KfvoError(f'{path}, line {row.line}: expected "{key}: {count} numbers", found '
                        f'{" ".join(row.fields)[:80]!r}') from error


def _read_projection(path: Path, key: str) -> np.ndarray:
    """Return the projection P (3, 4) of one camera, from camera 0's frame to pixels."""
    return _numbers(path, _read_rows_by_key(path), key, 12).reshape(3, 4)


def _read_camera(path: Path, key: str, width: int, height: int) -> Camera | None:
    if not path.is_file():
        return None
    return _make_camera(path, width, height, _read_projection(path, key))


def _read_raw_camera(path: Path, end: str, width: int, height: int) -> Camera | None:
    """Return the camera of the rectified images, or of those that still have another size."""
    if not path.is_file():
        return None
    rows = _read_rows_by_key(path)
    P = _numbers(path, rows, f'P_rect_{end}', 12).reshape(3, 4)
    if f'S_{end}' not in rows or \
            (width, height) != tuple(_numbers(path, rows, f'S_{end}', 2).tolist()):
        return _make_camera(path, width, height, P)
    K = _numbers(path, rows, f'K_{end}', 9).reshape(3, 3)
    return _make_camera(path, width, height, K, _numbers(path, rows, f'D_{end}', 5))


def _make_camera(path: Path, width: int, height: int, K: np.ndarray,
                 distortion: np.ndarray | tuple[()] = ()) -> Camera:
    try:
        return Camera(width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]),
                      float(K[1, 2]), 'plumb_bob', tuple(map(float, distortion)))
    except KfvoError as error:
        raise KfvoError(f'{path}: {error}') from error


def _read_ground_truth(path: Path, folder: str, stamps_ns: list[int]) -> GroundTruth | None:
    """Return T_world_camera: the file's T_world_camera0, for image_2 shifted by P2's offset."""
    poses = next((file for file in (path.parent.parent / 'poses' / f'{path.name}.txt',
                                    path / 'poses.txt') if file.is_file()), None)
    if poses is None:
        return None
    trajectory = read_kitti_poses(poses, np.array(stamps_ns, dtype=np.int64))
    if folder == 'image_0':
        return GroundTruth(trajectory)
    P = _read_projection(path / 'calib.txt', IMAGE_FOLDERS[folder])
    try:
        offset = -np.linalg.solve(P[:, :3], P[:, 3])
    except np.linalg.LinAlgError as error:
        raise KfvoError(f'{path / "calib.txt"}: expected an invertible '
                        f'{IMAGE_FOLDERS[folder]}, came {P.tolist()}') from error
    return GroundTruth(trajectory.right_multiplied(geometry.make_transform(np.eye(3), offset)))
