# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a keyframe policy sees and answers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.tracking.tracker import Tracks

POSE_SIZE = 7
ObservationLayout = tuple[tuple[str, int], ...]
"""Names of the parts of an observation and how many numbers each has, in order."""


@dataclass(frozen=True)
class DecisionInput:
    """The state of the window when the newest frame is to be kept or dropped.

    ``observation`` as `keyframes.observation` builds it; ``keyframe_tracks`` and
    ``newest_tracks`` those of the last keyframe and the newest frame (empty when neither
    backbone nor policy tracks); ``gap`` counts the input frames between the two.
    """

    observation: np.ndarray
    keyframe_tracks: Tracks
    newest_tracks: Tracks
    gap: int


class KeyframePolicy(ABC):
    """Decides, after each frame, whether it stays in the window."""

    name: str
    needs_tracks: bool = False

    @abstractmethod
    def decide(self, decision: DecisionInput) -> bool:
        """Return True to keep the newest frame as a keyframe."""


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


def layout_of(descriptor_size: int, window_size: int, signal_names: Sequence[str]) -> ObservationLayout:
    """Return the parts of what `observe` returns."""
    return (('descriptor', descriptor_size), ('poses', POSE_SIZE * (window_size - 1)),
            *((name, 1) for name in signal_names))


def indices_of(parts: ObservationLayout, layout: ObservationLayout) -> np.ndarray:
    """Return where the numbers of `parts` are in observations of `layout`.

    Raises KeyError naming a part that is not in there, in this size.
    """
    ends = np.cumsum([size for _, size in layout])
    places = {part: np.arange(end - part[1], end) for part, end in zip(layout, ends)}
    return np.concatenate([places[part] for part in parts])
