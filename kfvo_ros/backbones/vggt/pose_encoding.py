# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the nine numbers of a pose encoding mean: t (3), quat_xyzw (4), fov_h, fov_w [rad].

The pose is T_camera_world of optical frames; the quaternion need not be of unit length. Here
as in the model, h stands for the height and comes before the width.
"""

from __future__ import annotations

import numpy as np

from kfvo_ros import geometry


def transforms(encodings: np.ndarray) -> np.ndarray:
    """Return T_camera_world (..., 4, 4), float64, of encodings (..., 9)."""
    return geometry.transform_from_xyz_quat(np.asarray(encodings, dtype=np.float64)[..., :7])


def intrinsics(encodings: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return K (..., 3, 3) of images (height, width) [px]; a field of view of 0 gives infinity."""
    fields = np.asarray(encodings, dtype=np.float64)[..., 7:]
    K = np.zeros((*fields.shape[:-1], 3, 3))
    with np.errstate(divide='ignore'):
        K[..., 0, 0] = 0.5 * width / np.tan(0.5 * fields[..., 1])
        K[..., 1, 1] = 0.5 * height / np.tan(0.5 * fields[..., 0])
    K[..., 0, 2], K[..., 1, 2], K[..., 2, 2] = 0.5 * width, 0.5 * height, 1.0
    return K
