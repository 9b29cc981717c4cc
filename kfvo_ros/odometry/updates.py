# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Records of the odometry for each frame: keyframe, pose, step and update."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from kfvo_ros.backbones.base import Encoded, Points, Status
from kfvo_ros.keyframes.base import DecisionInput
from kfvo_ros.tracking.tracker import Tracks


@dataclass
class Keyframe:
    """A frame of the window; each window that contains it overwrites its pose.

    ``covariance`` (6, 6) is that of ``T_world_camera``, in world axes, translation first.
    """

    encoded: Encoded
    tracks: Tracks
    index: int
    T_world_camera: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class FramePose:
    """The pose of one input frame, relative to a keyframe.

    It follows the keyframe's refinement and is final once the keyframe leaves the window.
    """

    stamp_ns: int
    keyframe: Keyframe
    T_keyframe_camera: np.ndarray
    is_keyframe: bool

    @property
    def T_world_camera(self) -> np.ndarray:
        """The latest pose (4, 4) in trajectory units."""
        return self.keyframe.T_world_camera @ self.T_keyframe_camera


@dataclass(frozen=True)
class Step:
    """The newest frame after its window was integrated, before the keyframe decision.

    ``covariance`` (6, 6) is that of its pose in the world, ``window_covariance`` the part that
    arose in this window. ``decision`` is the policy's input; None while the window fills (then
    ``keep`` is True) and for a lost frame (False).
    """

    status: Status = Status.OK
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    window_covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    intrinsics: np.ndarray | None = None
    durations: Mapping[str, float] = field(default_factory=dict)
    decision: DecisionInput | None = None
    keep: bool = True


@dataclass(frozen=True)
class Update:
    """Result of one input frame.

    ``T_world_camera`` (4, 4) is the estimate at arrival, ``covariance`` (6, 6) its covariance
    in the world, translation first, and ``window_covariance`` the part that arose in this
    window. ``final`` are the frames whose poses became final, in input order; read their poses
    at once, since a keyframe that is still in the window may move. ``points`` of the window are
    in the world, None for a backbone without points. ``durations`` [s] are those of encode,
    estimate and decide, ``parts`` [s] those that the backbone measures within estimate.
    ``intrinsics`` K (3, 3) [px] is None unless the backbone estimates it.
    """

    stamp_ns: int
    T_world_camera: np.ndarray
    covariance: np.ndarray
    window_covariance: np.ndarray
    status: Status
    is_keyframe: bool
    final: tuple[FramePose, ...]
    points: Points | None
    durations: dict[str, float]
    intrinsics: np.ndarray | None = None
    parts: Mapping[str, float] = field(default_factory=dict)

    @property
    def median_depth(self) -> float | None:
        """Median distance of the points from the camera [units], None without points."""
        if self.points is None or not len(self.points.ids):
            return None
        return float(np.median(np.linalg.norm(
            self.points.positions - self.T_world_camera[:3, 3], axis=1)))
