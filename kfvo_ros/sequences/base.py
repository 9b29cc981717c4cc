# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What every sequence is: an iterator of frames, with ground truth where there is one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.trajectory import Trajectory

BODY_FRAME = 'body'
"""The rig that carries the camera, where the source does not name it."""


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
