# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The contract of sequences: stamped frames of one camera, with optional ground truth.

To add a dataset, write a module with a function that opens a folder and a `SequenceKind` named
``KIND``, and list the module in `kfvo_ros.sequences`. A dataset of image files returns an
`image_folder.ImageListSequence`; other sources subclass `Sequence`. See ``tum.py`` for a short
example.
"""

from __future__ import annotations

import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kfvo_ros.camera import Camera, guess_camera
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.sequences.calibration import CameraCalibration, read_calibration
from kfvo_ros.trajectory import Trajectory

BODY_FRAME = 'body'
"""The rig that carries the camera, where the source does not name it."""
CALIBRATION_FILE = 'camera_info.yaml'
"""Name of a ROS calibration file that overrides the calibration of the sequence beside it."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """One image: ``stamp_ns``, ``image`` (H, W) or (H, W, 3) RGB uint8, and its camera.

    ``camera`` is None without a calibration; backbones that need one raise KfvoError.
    """

    stamp_ns: int
    image: np.ndarray
    camera: Camera | None


@dataclass(frozen=True)
class GroundTruth:
    """Measured poses T_world_frame of one frame on the rig.

    ``frame`` is ``camera`` for the optical frame, else the name of the measured body, marker or
    prism, which no known transform connects to the camera.
    """

    trajectory: Trajectory
    frame: str = 'camera'


@dataclass(frozen=True)
class FixedTransform:
    """The pose of one frame on another that carries it: T_parent_child (4, 4)."""

    parent: str
    child: str
    T_parent_child: np.ndarray


class Sequence(ABC):
    """Frames of one camera in time order, read lazily; every iteration starts at the first.

    ``name`` is the display name (``kitti/03``). ``camera`` is None without a calibration.
    ``topic`` and ``camera_frame`` are the ROS names of the raw images and their optical frame.
    """

    name: str
    camera: Camera | None
    topic: str = '/camera/image_raw'
    camera_frame: str = 'camera_optical_frame'

    @property
    def left_out(self) -> dict[str, int]:
        """Number of images left out so far by the reason; ``late``, ``odd_stamp`` and others."""
        return {}

    @property
    def sources(self) -> dict[str, str]:
        """What was chosen among several, by key of the summary; topics of a bag."""
        return {}

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames, stamps strictly increasing; KfvoError at one that is unreadable."""

    @property
    @abstractmethod
    def length(self) -> int | None:
        """Number of frames, None where it is unknown before the last frame is read."""

    def ground_truth(self) -> GroundTruth | None:
        """Read and return the measured trajectory, None where there is none."""
        return None

    def extrinsics(self) -> tuple[FixedTransform, ...]:
        """Read and return the transforms from the body to camera_frame, empty if unknown."""
        return ()


@contextmanager
def choices_logged() -> Iterator[None]:
    """Show the choices among topics and transforms, which are logged at level INFO."""
    logger = logging.getLogger('kfvo_ros.sequences')
    level = logger.level
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)


def read_ground_truth(sequence: Sequence) -> tuple[GroundTruth | None, str | None]:
    """Return the ground truth, and the problem where it cannot be read: odometry needs none."""
    try:
        return sequence.ground_truth(), None
    except (KfvoError, ValueError, ArithmeticError, LookupError, TypeError, OSError) as error:
        _log.warning('%s: no ground truth: %s', sequence.name, reason_of(error))
        return None, reason_of(error)


def check_complete(sequence: Sequence, frame_count: int) -> None:
    """Log a warning where a sequence read to its end has fewer frames than its source states."""
    stated = sequence.length
    if stated is not None and frame_count < stated:
        left_out = sum(sequence.left_out.values())
        _log.warning('%s: read %d of the %d frames that it should have%s', sequence.name,
                     frame_count, stated, f'; {left_out} were left out' if left_out else
                     ': it is cut or damaged')


@dataclass(frozen=True)
class SequenceSettings:
    """User settings of a sequence; each kind ignores those that do not apply to it."""

    camera: Camera | CameraCalibration | None = None
    """Overrides every calibration that comes with the sequence."""

    image_topic: str | None = None
    """Image topic of a bag."""

    ground_truth_topic: str | None = None
    """Ground truth topic of a bag."""

    ground_truth_to_camera: np.ndarray | None = None
    """T_body_camera (4, 4), where body is the frame of the bag's ground truth."""

    rate: float = 10.0
    """Frames per second [Hz] of sources without stamps."""


@dataclass(frozen=True)
class SequenceKind:
    """One kind of sequence: its description for users, how to detect it and how to open it."""

    name: str
    description: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, SequenceSettings], Sequence]


@dataclass(frozen=True)
class Calibration:
    """Sources of a sequence's camera, in order of precedence.

    First ``override``, the user's; then CALIBRATION_FILE in ``folder``; then
    ``from_dataset(width, height)``, which is called only without the first two; last a guess.
    ``rectified`` images have the camera of the rectified images in a file.
    """

    override: Camera | CameraCalibration | None
    folder: Path
    from_dataset: Callable[[int, int], Camera | None] = lambda width, height: None
    rectified: bool = False

    def camera(self, name: str, width: int, height: int) -> Camera:
        """Return the camera of images of this size; a guess is logged as a warning.

        Raises KfvoError naming the sequence when a calibration is broken or of another aspect
        ratio.
        """
        camera, path = self.override, self.folder / CALIBRATION_FILE
        if camera is None and os.path.lexists(path):
            camera = read_calibration(path)
        if camera is None:
            camera = self.from_dataset(width, height) or _guess(name, width, height)
        try:
            if isinstance(camera, CameraCalibration):
                camera = camera.camera(self.rectified)
            return camera.scaled(width, height)
        except KfvoError as error:
            raise KfvoError(f'{name}: {error}') from error


def _guess(name: str, width: int, height: int) -> Camera:
    camera = guess_camera(width, height)
    _log.warning('%s has no calibration: guessing fx = fy = %.0f px for its %dx%d images, which '
                 'bends the trajectory where it is wrong; give a %s in its folder or --camera',
                 name, camera.fx, width, height, CALIBRATION_FILE)
    return camera
