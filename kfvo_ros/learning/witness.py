# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Who is told how a training goes; light to import, for whoever shows it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kfvo_ros.learning.validation import Score


class Witness(ABC):
    """What is raised here ends the training where nothing is cut in two: between two steps."""

    @abstractmethod
    def stepped(self, steps: int) -> None:
        """Take note of so many steps."""

    @abstractmethod
    def collected(self, mean_return: float, keyframe_rate: float) -> None:
        """Take note of the latest episodes' return, and of the share of frames kept."""

    @abstractmethod
    def validating(self) -> None:
        """Take note that another drive is about to be run."""

    @abstractmethod
    def validated(self, steps: int, score: Score, is_best: bool) -> None:
        """Take note of the policy's score after so many steps."""
