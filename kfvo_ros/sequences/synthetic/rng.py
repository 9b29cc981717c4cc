# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random numbers and rounding that give the same bytes on every platform.

Random numbers come from `RandomState.random_sample` only, whose stream is frozen and exact on
every platform. Maths libraries differ in the last digits of sines and cosines; `quantise` rounds
these away.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar('Item')
QUANTUM = 2.0 ** -20
"""Positions [m] and quaternions are integer multiples of this."""


class StableRng:
    """Platform-independent random numbers, seeded by a few integers of 0 to 2^32 - 1."""

    def __init__(self, *key: int) -> None:
        self._random = np.random.RandomState(list(key))

    def unit(self, *shape: int) -> np.ndarray:
        """Return an array of the given shape, uniform in [0, 1)."""
        return self._random.random_sample(shape)

    def between(self, low: float, high: float) -> float:
        """Return a number, uniform in [low, high)."""
        return low + (high - low) * float(self._random.random_sample())

    def integer(self, low: int, high: int) -> int:
        """Return an integer, uniform in [low, high)."""
        return low + int((high - low) * float(self._random.random_sample()))

    def chance(self, probability: float) -> bool:
        """Return True with the given probability."""
        return float(self._random.random_sample()) < probability

    def choice(self, items: Sequence[Item]) -> Item:
        """Return one of the items, each with the same probability."""
        return items[self.integer(0, len(items))]

    def shuffled(self, items: Sequence[Item]) -> list[Item]:
        """Return the items in random order."""
        return [items[index] for index in np.argsort(self.unit(len(items)), kind='stable')]


def quantise(value: float) -> float:
    """Return the nearest multiple of QUANTUM."""
    return round(value / QUANTUM) * QUANTUM
