# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Interface of keyframe policies, and the observation that learned policies see."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.tracking.tracker import Tracks

POSE_SIZE = 7
"""Numbers of a pose (t, quat_xyzw)."""
MIN_TRACKS = 8
"""With fewer tracks since the last keyframe their mean flow is not reliable: keep the frame."""
ObservationLayout = tuple[tuple[str, int], ...]
"""Names and sizes of the parts of an observation, in order."""


@dataclass(frozen=True)
class DecisionInput:
    """State of the window at a decision.

    ``observation`` (D,) float32 is that of `observe`. ``keyframe_tracks`` and ``newest_tracks``
    are those of the last keyframe and the newest frame, empty when neither backbone nor policy
    tracks. ``gap`` is the number of input frames from the last keyframe to the newest frame.
    """

    observation: np.ndarray
    keyframe_tracks: Tracks
    newest_tracks: Tracks
    gap: int


class KeyframePolicy(ABC):
    """Decides after each frame whether it stays in the window."""

    name: str
    needs_tracks: bool = False

    @abstractmethod
    def decide(self, decision: DecisionInput) -> bool:
        """Return True to keep the newest frame as a keyframe."""


def observe(descriptors: Sequence[np.ndarray], T_w_frame: np.ndarray,
            signals: np.ndarray) -> np.ndarray:
    """Return the observation (D + 7 (S - 1) + len(signals),) float32, not normalised.

    It holds the mean of the `descriptors` (D,) of the window's S frames, the poses
    T_newest_keyframe, oldest first, as (t, quat_xyzw), and the backbone's `signals`. `T_w_frame`
    (S, 4, 4) is in trajectory units. Source: the paper, section IV-B.
    """
    T_newest_keyframe = geometry.relative(T_w_frame[-1], T_w_frame[:-1])
    quat_xyzw = geometry.quat_xyzw_from_rotation(T_newest_keyframe[:, :3, :3])
    poses = np.concatenate([T_newest_keyframe[:, :3, 3], quat_xyzw], axis=1)
    return np.concatenate([np.mean(descriptors, axis=0), poses.ravel(),
                           signals]).astype(np.float32)


def layout_of(descriptor_size: int, window_size: int,
              signal_names: Sequence[str]) -> ObservationLayout:
    """Return the layout of what `observe` returns."""
    return (('descriptor', descriptor_size), ('poses', POSE_SIZE * (window_size - 1)),
            *((name, 1) for name in signal_names))


def indices_of(parts: ObservationLayout, layout: ObservationLayout) -> np.ndarray:
    """Return the indices of `parts` in observations of `layout`, in the order of `parts`.

    Raises KeyError for a part that the layout does not hold in this size.
    """
    ends = np.cumsum([size for _, size in layout])
    indices = {part: np.arange(end - part[1], end) for part, end in zip(layout, ends)}
    return np.concatenate([indices[part] for part in parts])
