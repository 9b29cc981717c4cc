# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences with ground truth to drive through again and again, encoded once or each time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from kfvo_ros.backbones.base import Backbone, Encoded
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Frame, Sequence
from kfvo_ros.trajectory import Trajectory, associate

NO_IMAGE = np.zeros((0, 0), dtype=np.uint8)


@dataclass(frozen=True)
class Drive:
    """Frames, what the backbone made of each, and where they truly were.

    ``encoded`` never depends on what was kept; those frames have lost their images. It is None
    where a frame has to be encoded when its turn comes. ``T_truth_camera`` (N, 4, 4) [m].
    """

    name: str
    frames: tuple[Frame, ...]
    encoded: tuple[Encoded | None, ...]
    T_truth_camera: np.ndarray

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def truth(self) -> Trajectory:
        """Return where the camera truly was when each frame was taken."""
        stamps_ns = np.array([frame.stamp_ns for frame in self.frames], dtype=np.int64)
        return Trajectory(stamps_ns, self.T_truth_camera)

    def since(self, start: int) -> Drive:
        """Return the drive without its first frames."""
        return Drive(self.name, self.frames[start:], self.encoded[start:],
                     self.T_truth_camera[start:])


def record(sequence: Sequence, backbone: Backbone | None, stop: int | None = None) -> Drive:
    """Encode a sequence, or hold its images if there is no `backbone` to do so.

    Frames without ground truth within 10 ms are left out. Raises KfvoError for a sequence whose
    true camera poses are not known.
    """
    truth = true_trajectory(sequence)
    seen = list(_seen(islice(sequence, stop), sequence, backbone))
    stamps_ns = np.array([frame.stamp_ns for frame, _ in seen], dtype=np.int64)
    matched, nearest = associate(stamps_ns, truth.stamps_ns)
    return Drive(sequence.name, tuple(seen[index][0] for index in matched),
                 tuple(seen[index][1] for index in matched), truth.poses[nearest])


def true_trajectory(sequence: Sequence) -> Trajectory:
    """Return where the camera truly was; raises KfvoError where that is not known."""
    truth = sequence.ground_truth()
    if truth is None or truth.frame != 'camera' or not truth.trajectory.has_rotation:
        came = 'none' if truth is None else f'that of {truth.frame}' + (
            '' if truth.trajectory.has_rotation else ' without rotations')
        raise KfvoError(f'{sequence.name}: expected ground truth of the camera to learn from, '
                        f'{came} came')
    return truth.trajectory


def _seen(frames: Iterator[Frame], sequence: Sequence,
          backbone: Backbone | None) -> Iterator[tuple[Frame, Encoded | None]]:
    """Yield what is kept of each frame."""
    stream = backbone.open(sequence.camera) if backbone is not None else None
    for frame in frames:
        if stream is None:
            yield frame, None
        else:
            yield replace(frame, image=NO_IMAGE), stream.encode(frame)
