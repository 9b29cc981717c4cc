# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From rendered radiance to a camera's image: blur, gain, noise, eight bits; integers only."""

from __future__ import annotations

import numpy as np
from numba import njit

from kfvo_ros.sequences.shading import RADIANCE_BITS

GAIN_BITS = 10
"""The gain has this many binary digits after the point."""
VALUE_BITS = RADIANCE_BITS + 4 + GAIN_BITS
"""Digits after the point of a grey value that was blurred (sixteenfold) and amplified."""
NOISE_SCALE = round(2.0 * (1 << VALUE_BITS) / 209.02)
"""Makes a sum of eight random bytes, of standard deviation 209.02, one of 2 grey values."""

_FRAME_STRIDE = 0xD1342543DE82EF95
"""Keeps the pixel counters of one frame far from those of the next."""
_WEYL, _MIX = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xD6E8FEB86659FD93)
_EVEN_BYTES, _SUM_OF_PAIRS = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0001000100010001)
_32, _8, _48 = np.uint64(32), np.uint64(8), np.uint64(48)


def expose(radiance: np.ndarray, gain: float, noise_key: int) -> np.ndarray:
    """Return the image (H, W) uint8 of a radiance (H, W) as `rendering.render` returns it.

    The lens blurs by a 3x3 binomial; the noise has sigma 2 grey values and is selected by
    `noise_key`, 64 bits.
    """
    image = np.empty(radiance.shape, dtype=np.uint8)
    key = np.uint64(noise_key * _FRAME_STRIDE % (1 << 64))
    _expose(radiance, round(gain * (1 << GAIN_BITS)), key, image)
    return image


@njit(cache=True)
def _expose(radiance, gain, noise_key, image):
    """Blur, amplify, add noise, round and clip."""
    height, width = radiance.shape
    column_sums = np.empty(width + 2, dtype=np.int64)
    half = 1 << (VALUE_BITS - 1)
    for v in range(height):
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        for u in range(width):
            column_sums[u + 1] = radiance[above, u] + 2 * radiance[v, u] + radiance[below, u]
        column_sums[0], column_sums[width + 1] = column_sums[1], column_sums[width]
        for u in range(width):
            blurred = column_sums[u] + 2 * column_sums[u + 1] + column_sums[u + 2]
            noise = NOISE_SCALE * _noise(noise_key, v * width + u)
            image[v, u] = min(max((blurred * gain + noise + half) >> VALUE_BITS, 0), 255)


@njit(cache=True)
def _noise(key, pixel):
    """Return the sum of the eight bytes of a pixel's hash, centred: nearly normal."""
    bits = (key + np.uint64(pixel)) * _WEYL
    bits = (bits ^ (bits >> _32)) * _MIX
    bits = (bits ^ (bits >> _32)) * _MIX
    pairs = (bits & _EVEN_BYTES) + ((bits >> _8) & _EVEN_BYTES)
    return np.int64((pairs * _SUM_OF_PAIRS) >> _48) - 1020
