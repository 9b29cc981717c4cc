# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What every sequence is: an iterator of frames, with ground truth where there is one."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kfvo_ros.camera import Camera, guess_camera, read_camera_info
from kfvo_ros.errors import KfvoError
from kfvo_ros.trajectory import Trajectory

BODY_FRAME = 'body'
"""The rig that carries the camera, where the source does not name it."""
CALIBRATION_FILE = 'camera_info.yaml'
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """One image: ``stamp_ns``, ``image`` (H, W) or (H, W, 3) RGB uint8, and its camera.

    ``camera`` is None where no calibration is known; backbones that need one refuse it.
    """

    stamp_ns: int
    image: np.ndarray
    camera: Camera | None


@dataclass(frozen=True)
class GroundTruth:
    """Measured poses of one point on the rig.

    ``frame`` says whose: ``camera`` (moved to the optical frame, T_world_camera) or the name
    of the body, marker or prism that was measured.
    """

    trajectory: Trajectory
    frame: str = 'camera'


@dataclass(frozen=True)
class FixedTransform:
    """How one named frame is mounted on another: T_parent_child (4, 4)."""

    parent: str
    child: str
    T_parent_child: np.ndarray


class Sequence(ABC):
    """Frames of one camera in time order, read lazily; iterate as often as you like.

    ``name`` is for people (``kitti/03``). ``camera`` may be None when nobody calibrated it.
    ``topic`` and ``camera_frame`` are what ROS calls its raw images and their optical frame.
    """

    name: str
    camera: Camera | None
    topic: str = '/camera/image_raw'
    camera_frame: str = 'camera_optical_frame'

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; raises KfvoError at one that cannot be read."""

    @property
    @abstractmethod
    def length(self) -> int | None:
        """Number of frames, None where only reading to the end would tell."""

    def ground_truth(self) -> GroundTruth | None:
        """Return the measured trajectory, read at the call, or None where there is none."""
        return None

    def extrinsics(self) -> tuple[FixedTransform, ...]:
        """Return what carries the camera: none, or transforms from the body to camera_frame."""
        return ()


@dataclass(frozen=True)
class SequenceSettings:
    """What a user may say about a sequence; a kind ignores what does not concern it."""

    camera: Camera | None = None
    """Wins over every calibration that comes with the sequence."""

    image_topic: str | None = None
    """Which images of a bag."""

    ground_truth_topic: str | None = None
    """Which measured trajectory of a bag."""

    ground_truth_to_camera: np.ndarray | None = None
    """T_body_camera (4, 4), body being what the bag's ground truth measured."""

    rate: float = 10.0
    """Frames per second [Hz] where nothing else gives stamps."""


@dataclass(frozen=True)
class SequenceKind:
    """One kind of sequence: how it looks, for people and for code, and how to open it."""

    name: str
    looks_like: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, SequenceSettings], Sequence]


@dataclass(frozen=True)
class Calibration:
    """Where the camera of a sequence may come from, in order of precedence.

    ``given`` by the user; CALIBRATION_FILE in ``folder``; ``own(width, height)``, what the
    dataset itself says, asked only when the first two are absent.
    """

    given: Camera | None
    folder: Path
    own: Callable[[int, int], Camera | None] = lambda width, height: None

    def camera(self, name: str, width: int, height: int) -> Camera:
        """Return the camera of images of this size; a guess is logged as a warning.

        Raises KfvoError naming the sequence when a calibration is broken or of another shape.
        """
        beside = self.folder / CALIBRATION_FILE
        if self.given is not None:
            camera = self.given
        elif beside.is_file():
            camera = read_camera_info(beside)
        else:
            camera = self.own(width, height) or _guess(name, width, height)
        try:
            return camera.scaled(width, height)
        except KfvoError as error:
            raise KfvoError(f'{name}: {error}') from error


def rigid_transform(numbers: object, what: str) -> np.ndarray:
    """Return T (4, 4) of 16 numbers in rows; KfvoError when they are no rigid transform."""
    try:
        transform = np.array(numbers, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        transform = np.zeros((4, 4))
    rotation = transform[:3, :3]
    if not (np.isfinite(transform).all() and np.allclose(transform[3], (0, 0, 0, 1))
            and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
            and np.linalg.det(rotation) > 0):
        found = ' '.join(str(numbers).split())
        raise KfvoError(f'{what}: expected a rigid 4x4 transform (a rotation, a translation, and '
                        f'0 0 0 1 below), found {found[:200]}')
    return transform


def _guess(name: str, width: int, height: int) -> Camera:
    camera = guess_camera(width, height)
    _log.warning('%s has no calibration: guessing fx = fy = %.0f px for its %dx%d images, which '
                 'bends the trajectory where it is wrong; give a %s in its folder or --camera',
                 name, camera.fx, width, height, CALIBRATION_FILE)
    return camera
