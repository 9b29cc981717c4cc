# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences of frames behind one interface: datasets, bags, folders, videos, rendered scenes."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import euroc, image_folder, kitti, tartanair, tum, video
from kfvo_ros.sequences.bag import sequence as bag
from kfvo_ros.sequences.base import Sequence, SequenceSettings
from kfvo_ros.sequences.calibration import CameraCalibration

SYNTHETIC = 'synthetic'
KINDS = {module.KIND.name: module.KIND
         for module in (euroc, tum, kitti, tartanair, bag, image_folder, video)}
"""Kinds of sequences on disk, in the order of detection."""


def open_sequence(source: str, *, kind: str | None = None,
                  camera: Camera | CameraCalibration | None = None,
                  image_topic: str | None = None, ground_truth_topic: str | None = None,
                  ground_truth_to_camera: np.ndarray | None = None,
                  rate: float = 10.0) -> Sequence:
    """Open a dataset, a bag, a folder of images, a video or a rendered scene.

    ::

        sequence = open_sequence('rgbd_dataset_freiburg1_desk')
        for frame in sequence:
            print(frame.stamp_ns, frame.image.shape, frame.camera.fx)
        ground_truth = sequence.ground_truth()

    Frames are decoded one at a time, so memory does not grow with the length, and a sequence
    can be iterated repeatedly. Opening reads the index and the first image only.

    Args:
        source: A path, or ``synthetic:SEED[:STYLE]`` for a rendered scene. Paths may be an EuRoC
            or TUM VI folder (with ``mav0``), a TUM RGB-D folder, KITTI ``sequences/NN`` or a
            raw drive, a TartanAir trajectory, a ROS 1 or ROS 2 bag, a folder of images or a
            video file.
        kind: Name of one of KINDS or ``synthetic``; detected by default.
        camera: Calibration that overrides all others: the Camera of the images, or the
            CameraCalibration of a file, of which rectified topics have another camera than raw
            ones. By default a ``camera_info.yaml`` in the folder is used, else the dataset's own
            calibration or the bag's CameraInfo, else a guess, with a warning
            (``sequence.camera.guessed``).
        image_topic: Image topic of a bag; by default the first by name of those with a
            CameraInfo, never one of depth images.
        ground_truth_topic: Ground truth topic of a bag; chosen by name and message type by
            default.
        ground_truth_to_camera: T_body_camera (4, 4), the camera on the body whose ground truth
            a bag recorded; by default the bag's static transforms are used.
        rate: Frames per second [Hz] of sources without stamps: folders, TartanAir, and videos
            that do not state theirs.

    Raises:
        KfvoError: `source` is no known sequence, or its index, first image or calibration
            cannot be read.
    """
    if kind is not None and kind not in (*KINDS, SYNTHETIC):
        raise KfvoError(f'unknown kind of sequence {kind!r}; expected one of '
                        f'{", ".join((*KINDS, SYNTHETIC))}')
    if kind == SYNTHETIC or (kind is None and source.startswith(f'{SYNTHETIC}:')):
        from kfvo_ros.sequences.synthetic.sequence import parse_synthetic
        return parse_synthetic(source)
    # Absolute, so that '.' has a name; links stay, because their name may identify the dataset.
    path = Path(os.path.abspath(os.path.expanduser(source)))
    settings = SequenceSettings(camera, image_topic, ground_truth_topic, ground_truth_to_camera,
                                rate)
    return KINDS[kind or _detect_kind(path)].open(path, settings)


def _detect_kind(path: Path) -> str:
    """Return the name of the first kind that matches, else raise a KfvoError that lists all."""
    for kind in KINDS.values():
        if kind.matches(path):
            return kind.name
    descriptions = '; '.join(kind.description for kind in KINDS.values())
    problem = 'is not a known kind of sequence' if path.exists() else 'does not exist'
    raise KfvoError(f'{path} {problem}; expected {descriptions}; or '
                    f'{SYNTHETIC}:SEED[:smooth|fast|mixed|street]')
