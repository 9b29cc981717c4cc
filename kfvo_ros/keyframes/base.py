# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a keyframe policy sees and answers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from kfvo_ros.tracking import Tracks


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
