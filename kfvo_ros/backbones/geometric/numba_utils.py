# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled functions of the geometric backbone: decorators, and medians."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import boolean, float64, int64

from kfvo_ros.utils.compiler import Compiler, Kernel

compiled = Compiler(Path(__file__).parent, nogil=True, error_model='numpy',
                    fastmath={'contract', 'reassoc'})
"""Decorator for helpers of entry points, which are compiled with their callers.

Reassociation lets the processor vectorise sums."""

_entry_points: list[tuple[Any, tuple[Any, ...]]] = []
"""Compiled functions and the argument types to compile them for."""


def entry_point(*argument_types: Any) -> Callable[[Kernel], Kernel]:
    """Return a decorator for a compiled function that the interpreter calls with these types."""
    def register(function: Kernel) -> Kernel:
        kernel = compiled(function)
        _entry_points.append((kernel, argument_types))
        return kernel
    return register


def compile_entry_points() -> None:
    """Compile the entry points of all imported modules, or load them from the cache."""
    for kernel, argument_types in _entry_points:
        kernel.compile(argument_types)


@compiled
def _partition(values: np.ndarray, first: int, last: int, limit: float) -> int:
    """Move the values below `limit` to the front of values[first:last]; return their end.

    The loop has no branch: mispredicted ones cost more than the swaps.
    """
    end = first
    for k in range(first, last):
        value = values[k]
        values[k], values[end] = values[end], value
        end += value < limit
    return end


@compiled
def _select(values: np.ndarray, rank: int) -> float:
    """Return the value of a rank, counted from 0, and move all smaller ones before it."""
    first, last = 0, len(values)
    while True:
        pivot = values[(first + last) // 2]
        less_end = _partition(values, first, last, pivot)
        if rank < less_end:
            last = less_end
            continue
        equal_end = _partition(values, less_end, last, np.nextafter(pivot, np.inf))
        if rank < equal_end or equal_end == less_end:  # Nothing equals NaN, or exceeds inf.
            return pivot
        first = equal_end


@entry_point(float64[::1])
def median(values: np.ndarray) -> float:
    """Return the median of (N,), N >= 1; equals NumPy's, at a tenth of its time for small N."""
    values = values.copy()
    half = len(values) // 2
    upper = lower = _select(values, half)
    if len(values) % 2 == 0:
        lower = values[0]
        for k in range(1, half):
            lower = max(lower, values[k])
    return 0.5 * (lower + upper)


@entry_point(float64[:, ::1], boolean[:, ::1])
def median_where(values: np.ndarray, mask: np.ndarray) -> tuple[float, int]:
    """Return the median of `values` (F, P) under `mask`, 0 for an empty one, and their count."""
    kept, count = np.empty(values.size + 1), 0
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            kept[count] = values[row, column]
            count += mask[row, column]
    return (median(kept[:count]) if count > 0 else 0.0), count


@entry_point(float64[:, ::1], float64[:, ::1], float64[::1], int64)
def medians_of_nearest(queries: np.ndarray, points: np.ndarray, values: np.ndarray,
                       neighbours: int) -> np.ndarray:
    """Return medians (N,) of the `values` (M,) of the nearest `points` (M, 2) to `queries` (N, 2).

    `neighbours` <= M is the number of nearest points.
    """
    medians = np.zeros(len(queries))
    distances, nearest = np.zeros(neighbours), np.zeros(neighbours)
    for n in range(len(queries)):
        distances[:] = np.inf
        for k in range(len(values)):
            x, y = points[k, 0] - queries[n, 0], points[k, 1] - queries[n, 1]
            distance, value = x * x + y * y, values[k]
            if distance >= distances[-1]:
                continue
            for rank in range(neighbours):
                if distance < distances[rank]:
                    distance, distances[rank] = distances[rank], distance
                    value, nearest[rank] = nearest[rank], value
        medians[n] = median(nearest)
    return medians
