# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What opening a sequence takes: the user's wishes, and how each kind is told apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.sequences.base import Sequence


@dataclass(frozen=True)
class Options:
    """What a user may say about a sequence; a kind ignores what does not concern it."""

    camera: Camera | None = None
    """Wins over every calibration that comes with the sequence."""

    image_topic: str | None = None
    """Which images of a bag."""

    ground_truth_topic: str | None = None
    """Which measured trajectory of a bag."""

    ground_truth_to_camera: np.ndarray | None = None
    """T_body_camera (4, 4), body being what the bag's ground truth measured."""

    rate: float = 10.0
    """Frames per second [Hz] where nothing else gives stamps."""


@dataclass(frozen=True)
class Kind:
    """One kind of sequence: how it looks, for people and for code, and how to open it."""

    name: str
    looks_like: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, Options], Sequence]
