# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""State passed from window to window: poses and points in the world, with covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Points, WindowPrior


class HasPose(Protocol):
    """An object with a pose."""

    T_world_camera: np.ndarray


@dataclass(frozen=True)
class WindowState:
    """The latest pose T_world_latest (4, 4), points in the world, and the backbone's memory.

    ``memory_scale`` is trajectory units per unit of ``memory``.
    """

    T_world_latest: np.ndarray = field(default_factory=lambda: np.eye(4))
    points: Points | None = None
    memory: Any = None
    memory_scale: float = 1.0

    def prior_of(self, keyframes: Sequence[HasPose]) -> WindowPrior | None:
        """Return the prior of the window that `keyframes` start; None before any estimate."""
        if len(keyframes) == 1 and self.memory is None and self.points is None:
            return None
        T_anchor_world = geometry.invert(keyframes[0].T_world_camera)
        T_anchor_frame = T_anchor_world @ np.array([k.T_world_camera for k in keyframes])
        T_anchor_frame[0] = np.eye(4)
        return WindowPrior(T_anchor_frame, T_anchor_world @ self.T_world_latest,
                           transform_points(self.points, T_anchor_world, 1.0),
                           self.memory, self.memory_scale)


def scale_poses(poses: np.ndarray, scale: float) -> np.ndarray:
    """Return poses (..., 4, 4) with translations multiplied by `scale`."""
    result = poses.copy()
    result[..., :3, 3] *= scale
    return result


def transform_points(points: Points | None, T_b_a: np.ndarray, scale: float) -> Points | None:
    """Return points in frame b of points in frame a, multiplied by `scale` first."""
    if points is None:
        return None
    positions = scale * points.positions @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    return Points(points.ids, positions, points.information)


def rotate_covariance(covariance: np.ndarray, T_b_a: np.ndarray, scale: float) -> np.ndarray:
    """Return a covariance (6, 6), translation first, in axes of b, its translations scaled."""
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3], jacobian[3:, 3:] = scale * T_b_a[:3, :3], T_b_a[:3, :3]
    return jacobian @ covariance @ jacobian.T


def propagate_covariance(relative: np.ndarray, reference: np.ndarray,
                         offset: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) of a frame relative to an uncertain reference frame.

    `relative` is the covariance of the frame relative to the reference, `reference` that of the
    reference, `offset` (3,) the vector from the reference to the frame; all in world axes. A
    rotation of the reference moves the frame by this lever arm.
    """
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -geometry.skew(offset)
    return jacobian @ reference @ jacobian.T + relative
