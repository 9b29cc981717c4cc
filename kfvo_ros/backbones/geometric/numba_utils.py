# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the loops of this backbone are compiled: once, kept on disk, free of the interpreter.

What is kept is found by a function's name and the age of its file. But machine code also holds
what is called in other files, and the layout of the tuples that come and go: a new version of
those would be run by old code. So all that is compiled here has their digest in its name.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numba
import numpy as np

_compile = numba.njit(cache=True, nogil=True, error_model='numpy',
                      fastmath={'contract', 'reassoc'})
"""Sums may be taken in any order, which lets the processor take several terms at a time."""


def _digest() -> str:
    """Return a few digits that another version of any of the sources changes."""
    sources = [path.read_bytes() for path in sorted(Path(__file__).parent.glob('*.py'))]
    return hashlib.sha256(b''.join(
        source for source in sources if b'@compiled' in source or b'(NamedTuple)' in source)
    ).hexdigest()[:8]


_DIGEST = _digest()


def compiled(function: Any) -> Any:
    """Compile a function of arrays, numbers and named tuples when it is called first."""
    function.__qualname__ += f'_{_DIGEST}'
    return _compile(function)


@compiled
def _gather(values: np.ndarray, first: int, last: int, limit: float) -> int:
    """Bring those of values[first:last] below the limit to the front; return where they end.

    No step depends on a comparison: a processor loses time where it cannot foresee the next one.
    """
    end = first
    for k in range(first, last):
        value = values[k]
        values[k], values[end] = values[end], value
        end += value < limit
    return end


@compiled
def _select(values: np.ndarray, rank: int) -> float:
    """Return the value of a rank, counted from 0, and bring all below it before it."""
    first, last = 0, len(values)
    while True:
        pivot = values[(first + last) // 2]
        less_end = _gather(values, first, last, pivot)
        if rank < less_end:
            last = less_end
            continue
        equal_end = _gather(values, less_end, last, np.nextafter(pivot, np.inf))
        if rank < equal_end or equal_end == less_end:  # Nothing equals NaN, or exceeds inf.
            return pivot
        first = equal_end


@compiled
def median(values: np.ndarray) -> float:
    """Return the median of (N,), N >= 1: as NumPy's, which spends ten times as long on few."""
    values = values.copy()
    half = len(values) // 2
    upper = lower = _select(values, half)
    if len(values) % 2 == 0:
        lower = values[0]
        for k in range(1, half):
            lower = max(lower, values[k])
    return 0.5 * (lower + upper)


@compiled
def median_where(values: np.ndarray, mask: np.ndarray) -> tuple[float, int]:
    """Return the median of `values` (F, P) under `mask`, and how many there are; 0 without any."""
    kept, count = np.empty(values.size + 1), 0
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            kept[count] = values[row, column]
            count += mask[row, column]
    return (median(kept[:count]) if count > 0 else 0.0), count


@compiled
def medians_of_nearest(places, known_places, known_values, neighbours):
    """Return medians (N,) of the values of the known points nearest to each place (N, 2)."""
    medians = np.zeros(len(places))
    distances, nearest = np.zeros(neighbours), np.zeros(neighbours)
    for n in range(len(places)):
        distances[:] = np.inf
        for k in range(len(known_values)):
            x, y = known_places[k, 0] - places[n, 0], known_places[k, 1] - places[n, 1]
            distance, value = x * x + y * y, known_values[k]
            if distance >= distances[-1]:
                continue
            for rank in range(neighbours):
                if distance < distances[rank]:
                    distance, distances[rank] = distances[rank], distance
                    value, nearest[rank] = nearest[rank], value
        medians[n] = median(nearest)
    return medians
