# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random numbers and random surfaces of rendered sequences, the same for ever.

Only `RandomState.random_sample` is drawn from, whose stream is frozen and exact on every
platform, and only elementwise arithmetic follows, which NumPy rounds alike everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from kfvo_ros.sequences.synthetic.shading import TEXTURE_SIZE as SIZE

Item = TypeVar('Item')


class StableRng:
    """Random numbers of a key: a few integers of 0 to 2^32 - 1."""

    def __init__(self, *key: int) -> None:
        self._random = np.random.RandomState(list(key))

    def unit(self, *shape: int) -> np.ndarray:
        """Return numbers of [0, 1)."""
        return self._random.random_sample(shape)

    def between(self, low: float, high: float) -> float:
        """Return a number of [low, high)."""
        return low + (high - low) * float(self._random.random_sample())

    def integer(self, low: int, high: int) -> int:
        """Return an integer of [low, high)."""
        return low + int((high - low) * float(self._random.random_sample()))

    def chance(self, probability: float) -> bool:
        """Return True with a probability."""
        return float(self._random.random_sample()) < probability

    def choice(self, items: Sequence[Item]) -> Item:
        """Return one of the items."""
        return items[self.integer(0, len(items))]

    def shuffled(self, items: Sequence[Item]) -> list[Item]:
        """Return the items in a random order."""
        return [items[place] for place in np.argsort(self.unit(len(items)), kind='stable')]


def noise(rng: StableRng, rows: int, columns: int) -> np.ndarray:
    """Return smooth noise (SIZE, SIZE) in [-1, 1] through rows x columns values, periodic."""
    lattice = 2.0 * rng.unit(rows, columns) - 1.0
    before, after, share = _blend(rows)
    lines = lattice[before] * (1.0 - share[:, None]) + lattice[after] * share[:, None]
    before, after, share = _blend(columns)
    return lines[:, before] * (1.0 - share) + lines[:, after] * share


def fractal(rng: StableRng, coarsest: int, finest: int, decay: float) -> np.ndarray:
    """Return the sum (SIZE, SIZE) of noise of `coarsest` to `finest` cells, doubling."""
    total, weight, cells = np.zeros((SIZE, SIZE)), 1.0, coarsest
    while cells <= finest:
        total += weight * noise(rng, cells, cells)
        weight, cells = weight * decay, cells * 2
    return total


def _blend(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the values before and after every texel, and the share (SIZE,) of the latter."""
    place = np.arange(SIZE) * (count / SIZE)
    before = place.astype(np.int64)
    share = place - before
    return before, (before + 1) % count, share * share * (3.0 - 2.0 * share)
