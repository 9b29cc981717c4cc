# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What two frames have in common, by their increasing track ids."""

from __future__ import annotations

import numpy as np


def shared(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the same ids stand in `a` and in `b`, both increasing: indices (M,) each."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    places = b.searchsorted(a)
    in_a = np.flatnonzero(b.take(places, mode='clip') == a)
    return in_a, places[in_a]


def present(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of the ids in `a` that are in `b` too, both increasing."""
    mask = np.zeros(len(a), dtype=bool)
    mask[shared(a, b)[0]] = True
    return mask
