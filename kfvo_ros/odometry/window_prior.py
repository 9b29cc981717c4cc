# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What one window leaves to the next: poses and points, in the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Points, WindowPrior


class HasPose(Protocol):
    """Anything with a pose."""

    T_world_camera: np.ndarray


@dataclass(frozen=True)
class WindowState:
    """The latest frame's pose, the latest points in the world, and the backbone's memory.

    ``covariance`` (6, 6) is that of the pose where a frame was last placed.
    """

    T_world_latest: np.ndarray = field(default_factory=lambda: np.eye(4))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    points: Points | None = None
    memory: Any = None
    memory_scale: float = 1.0

    def seen_from(self, keyframes: Sequence[HasPose]) -> WindowPrior | None:
        """Return the hint for a window that starts with `keyframes`; None before any estimate."""
        if len(keyframes) == 1 and self.memory is None and self.points is None:
            return None
        T_anchor_world = geometry.invert(keyframes[0].T_world_camera)
        T_anchor_frame = T_anchor_world @ np.array([k.T_world_camera for k in keyframes])
        T_anchor_frame[0] = np.eye(4)
        return WindowPrior(T_anchor_frame, T_anchor_world @ self.T_world_latest,
                           transform_points(self.points, T_anchor_world, 1.0), self.memory, self.memory_scale)


def scale_poses(poses: np.ndarray, scale: float) -> np.ndarray:
    """Return poses (..., 4, 4) in another unit."""
    result = poses.copy()
    result[..., :3, 3] *= scale
    return result


def transform_points(points: Points | None, T_b_a: np.ndarray, scale: float) -> Points | None:
    """Return points of frame a, in another unit, in frame b."""
    if points is None:
        return None
    positions = scale * points.positions @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    return Points(points.ids, positions, points.information)


def rotate_covariance(covariance: np.ndarray, T_b_a: np.ndarray, scale: float) -> np.ndarray:
    """Return a covariance (6, 6) of frame a, in another unit, in the axes of frame b."""
    into = np.zeros((6, 6))
    into[:3, :3], into[3:, 3:] = scale * T_b_a[:3, :3], T_b_a[:3, :3]
    return into @ covariance @ into.T


def propagate_covariance(covariance: np.ndarray, of_carrier: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) of a frame whose carrier is uncertain too.

    `covariance` is the frame's against its carrier, `offset` (3,) leads from there to the frame;
    all in the axes of one world. Where the carrier is turned, the frame is moved.
    """
    lever = np.eye(6)
    lever[:3, 3:] = -geometry.skew(offset)
    return lever @ of_carrier @ lever.T + covariance
