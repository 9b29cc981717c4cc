# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the learned policy sees of a window (paper, section IV-B)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kfvo_ros import geometry

POSE_SIZE = 7
Layout = tuple[tuple[str, int], ...]
"""Names of the parts of an observation and how many numbers each has, in order."""


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


def layout_of(descriptor_size: int, window_size: int, signal_names: Sequence[str]) -> Layout:
    """Return the parts of what `observe` returns."""
    return (('descriptor', descriptor_size), ('poses', POSE_SIZE * (window_size - 1)),
            *((name, 1) for name in signal_names))


def indices_of(parts: Layout, layout: Layout) -> np.ndarray:
    """Return where the numbers of `parts` are in observations of `layout`.

    Raises KeyError naming a part that is not in there, in this size.
    """
    ends = np.cumsum([size for _, size in layout])
    places = {part: np.arange(end - part[1], end) for part, end in zip(layout, ends)}
    return np.concatenate([places[part] for part in parts])
