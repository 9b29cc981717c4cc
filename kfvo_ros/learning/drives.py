# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences with ground truth to drive through again and again, encoded once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from kfvo_ros.backbones.base import Backbone, Encoded
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Frame, Sequence
from kfvo_ros.trajectory import associate

NO_IMAGE = np.zeros((0, 0), dtype=np.uint8)


@dataclass(frozen=True)
class Drive:
    """Frames, what the backbone made of each, and where they truly were.

    ``encoded`` never depends on what was kept; the ``frames`` have lost their images.
    ``T_truth_camera`` (N, 4, 4) [m].
    """

    name: str
    frames: tuple[Frame, ...]
    encoded: tuple[Encoded, ...]
    T_truth_camera: np.ndarray

    def __len__(self) -> int:
        return len(self.frames)


def record(sequence: Sequence, backbone: Backbone, stop: int | None = None) -> Drive:
    """Encode a sequence; frames without ground truth within 10 ms are left out.

    Raises KfvoError for a sequence whose true camera poses are not known.
    """
    truth = sequence.ground_truth()
    if truth is None or truth.frame != 'camera' or not truth.trajectory.has_rotation:
        raise KfvoError(f'{sequence.name}: expected ground truth of the camera to learn from, '
                        + ('none came' if truth is None else f'that of {truth.frame} came'))
    stream, frames, encoded = backbone.open(sequence.camera), [], []
    for frame in islice(sequence, stop):
        encoded.append(stream.encode(frame))
        frames.append(replace(frame, image=NO_IMAGE))
    stamps_ns = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
    matched, nearest = associate(stamps_ns, truth.trajectory.stamps_ns)
    return Drive(sequence.name, tuple(frames[index] for index in matched),
                 tuple(encoded[index] for index in matched), truth.trajectory.poses[nearest])
