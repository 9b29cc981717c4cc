# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Epipolar errors of tracks for a known motion."""

from __future__ import annotations

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.camera import Camera


def epipolar_errors(camera: Camera, first: np.ndarray, second: np.ndarray,
                    T_second_first: np.ndarray) -> np.ndarray:
    """Return the Sampson distances (N,) [px] of pixels (N, 2) in two images."""
    E = geometry.skew(T_second_first[:3, 3]) @ T_second_first[:3, :3]
    rays = [np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
            for pixels in (first, second)]
    lines_second, lines_first = rays[0] @ E.T, rays[1] @ E
    distances = np.sum(rays[1] * lines_second, axis=1) / np.sqrt(
        np.sum(lines_second[:, :2] ** 2, axis=1) + np.sum(lines_first[:, :2] ** 2, axis=1))
    return np.abs(distances) * camera.fx
