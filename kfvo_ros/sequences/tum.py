# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TUM RGB-D dataset: rgb.txt, groundtruth.txt, and intrinsics by the folder's name.

Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012;
intrinsics from the calibration page of the dataset.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from kfvo_ros.camera import Camera
from kfvo_ros.sequences.base import Calibration, GroundTruth, SequenceKind, SequenceSettings
from kfvo_ros.sequences.image_folder import ImageListSequence
from kfvo_ros.trajectory import parse_stamp_ns, read_pose_table
from kfvo_ros.utils.files import read_rows

KINECT_READOUT = 0.030
"""Readout time [s]: nearly the whole frame interval of 33 ms (Ringaby and Forssen,
"Scan rectification for structured light range sensors with rolling shutters", ICCV 2011)."""
FREIBURG = {
    '1': Camera(640, 480, 517.306408, 516.469215, 318.643040, 255.313989, 'plumb_bob',
                (0.262383, -0.953104, -0.005358, 0.002628, 1.163314), readout_s=KINECT_READOUT),
    '2': Camera(640, 480, 520.908620, 521.007327, 325.141442, 249.701764, 'plumb_bob',
                (0.231222, -0.784899, -0.003257, -0.000105, 0.917205), readout_s=KINECT_READOUT),
    '3': Camera(640, 480, 535.4, 539.2, 320.1, 247.6, readout_s=KINECT_READOUT),
}
"""The colour cameras of freiburg1, 2 and 3; the images of freiburg3 are rectified."""


def open_tum(path: Path, settings: SequenceSettings) -> ImageListSequence:
    """Open the colour camera of a sequence folder."""
    images = read_rows(path / 'rgb.txt', 'timestamp filename', _parse_image)
    return ImageListSequence(path.name, path, images,
                             Calibration(settings.camera, path, partial(_camera_of, path.name)),
                             partial(_read_ground_truth, path / 'groundtruth.txt'))


KIND = SequenceKind('tum', 'TUM RGB-D: rgb.txt',
                    lambda path: (path / 'rgb.txt').is_file(), open_tum)


def _parse_image(line: str) -> tuple[int, str]:
    stamp, file_name = line.split(maxsplit=1)
    return parse_stamp_ns(stamp), file_name


def _camera_of(name: str, width: int, height: int) -> Camera | None:
    match = re.search(r'(?:^|_)(?:freiburg|fr)([123])(?:_|$)', name)
    return FREIBURG[match[1]] if match else None


def _read_ground_truth(path: Path) -> GroundTruth | None:
    """Return the file's poses, which are those of the colour camera's optical frame."""
    return GroundTruth(read_pose_table(path, parse_stamp_ns)) if path.is_file() else None
