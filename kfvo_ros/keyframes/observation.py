# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the learned policy sees of a window (paper, section IV-B)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kfvo_ros import geometry


def observe(descriptors: Sequence[np.ndarray], T_w_frame: np.ndarray,
            signals: np.ndarray) -> np.ndarray:
    """Return the observation as float32: descriptor, relative poses, signals; not normalised.

    `descriptors` of the window's S frames (D,) are averaged; `T_w_frame` (S, 4, 4), in
    trajectory units, become T_newest_keyframe, oldest first, as (t, quat_xyzw);
    the backbone's `signals` follow in their declared order: D + 7 (S - 1) + len(signals).
    """
    T_newest_keyframe = geometry.relative(T_w_frame[-1], T_w_frame[:-1])
    quat_xyzw = geometry.quat_xyzw_from_rotation(T_newest_keyframe[:, :3, :3])
    poses = np.concatenate([T_newest_keyframe[:, :3, 3], quat_xyzw], axis=1)
    return np.concatenate([np.mean(descriptors, axis=0), poses.ravel(),
                           signals]).astype(np.float32)
