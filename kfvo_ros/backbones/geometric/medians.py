# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Medians of a few to a few thousand numbers, compiled: a window asks for dozens of them."""

from __future__ import annotations

import numpy as np

from kfvo_ros.backbones.geometric.compilation import compiled


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
