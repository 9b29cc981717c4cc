# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the faces of rendered boxes look: trilinear textures under one lamp.

Textures are square, repeat in both directions and are kept as pyramids of halved levels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

TEXTURE_BITS = 9
TEXTURE_SIZE = 1 << TEXTURE_BITS
"""Texels along a side of the finest level."""
LEVEL_STARTS = np.array([(4 ** (TEXTURE_BITS + 1) - 4 ** (TEXTURE_BITS + 1 - level)) // 3
                         for level in range(TEXTURE_BITS + 1)])
"""Where each level starts in a pyramid, the finest first."""
FACE = np.dtype([('texture', np.int32), ('scale_u', np.float64), ('scale_v', np.float64),
                 ('offset_u', np.float64), ('offset_v', np.float64),
                 ('bias', np.float64), ('contrast', np.float64)])
"""How a face is painted: with bias + contrast * texel, the texel at scale [1/m] * place [m]
from the middle of the face + offset."""
RADIANCE_BITS = 6
"""Radiances are grey values with this many binary digits after the point."""
AMBIENT, DIFFUSE, LIGHT_RANGE = 0.65, 0.7, 3.0
"""Light: a constant, and what the lamp adds, which is halved at this distance [m]."""
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


class BoxFrameCamera(NamedTuple):
    """A camera in every box's frame.

    A pixel looks along ``rays`` (K, 3, 3) @ (u, v, 1), of length one along the optical axis,
    from ``origins`` (K, 3) [m]; ``focal`` [px].
    """

    rays: np.ndarray
    origins: np.ndarray
    focal: float


def build_pyramid(texture: np.ndarray) -> np.ndarray:
    """Return all levels, flat and uint8, of grey values (TEXTURE_SIZE, TEXTURE_SIZE)."""
    level: np.ndarray = np.clip(np.floor(texture + 0.5), 0.0, 255.0).astype(np.uint16)
    levels = [level.ravel()]
    for _ in range(TEXTURE_BITS):
        level = (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2]
                 + 2) >> 2
        levels.append(level.ravel())
    return np.concatenate(levels).astype(np.uint8)


@njit(cache=True)
def shade(scene, view, hits, depth, radiance):
    """Write the radiance (H, W) int32 of `hits` (H, W), 6 * box + side, at `depth` (H, W)."""
    height, width = hits.shape
    lookups = np.empty((4, width))
    for v in range(height):
        left = 0
        while left < width:
            hit, right = hits[v, left], left + 1
            while right < width and hits[v, right] == hit:
                right += 1
            _look_up(scene, view, hit // 6, hit % 6, v, left, right, depth, lookups)
            face = scene.faces[hit // 6, hit % 6]
            bias, contrast, pyramid = face.bias, face.contrast, scene.pyramids[face.texture]
            for u in range(left, right):
                texel = _sample(pyramid, lookups[0, u], lookups[1, u], lookups[2, u])
                radiance[v, u] = int((bias + contrast * texel) * lookups[3, u])
            left = right


@njit(cache=True)
def _look_up(scene, view, box, side, v, left, right, depth, lookups):
    """Write where a row of pixels meets a face's texture, u, v, how wide, and the light there."""
    rays, face = view.rays, scene.faces[box, side]
    origin_x, origin_y, origin_z = view.origins[box]
    cosine, sine = scene.turns[box]
    centre_x, centre_y, centre_z = scene.centres[box]
    lamp_x, lamp_y, lamp_z = scene.lamp
    scale = max(face.scale_u, face.scale_v) / view.focal
    for u in range(left, right):
        ray_x = rays[box, 0, 0] * u + rays[box, 0, 1] * v + rays[box, 0, 2]
        ray_y = rays[box, 1, 0] * u + rays[box, 1, 1] * v + rays[box, 1, 2]
        ray_z = rays[box, 2, 0] * u + rays[box, 2, 1] * v + rays[box, 2, 2]
        x = origin_x + depth[v, u] * ray_x
        y = origin_y + depth[v, u] * ray_y
        z = origin_z + depth[v, u] * ray_z
        across, down = y if side < 2 else x, -z if side < 4 else y
        lookups[0, u] = across * face.scale_u + face.offset_u
        lookups[1, u] = down * face.scale_v + face.offset_v
        # Seen squarely, a pixel covers depth / focal; on a slanted face it covers more, one way.
        # The geometric mean of both ways lies between blur and aliasing.
        facing = abs(ray_x if side < 2 else ray_y if side < 4 else ray_z)
        length = math.sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z)
        lookups[2, u] = depth[v, u] * scale * math.sqrt(length / max(facing, 0.02))
        to_x = cosine * x - sine * y + centre_x - lamp_x
        to_y = sine * x + cosine * y + centre_y - lamp_y
        to_z = z + centre_z - lamp_z
        squared = (to_x * to_x + to_y * to_y + to_z * to_z) / (LIGHT_RANGE * LIGHT_RANGE)
        lookups[3, u] = (AMBIENT + DIFFUSE / (1.0 + squared)) * (1 << RADIANCE_BITS)


@njit(cache=True)
def _sample(pyramid, u, v, footprint):
    """Return the grey value at (u, v) where a pixel covers `footprint` texels, trilinear."""
    level = 0
    while footprint >= 2.0 and level < TEXTURE_BITS - 2:
        footprint *= 0.5
        level += 1
    value = _interpolate(pyramid, u, v, level)
    blend = int(256.0 * (min(footprint, 2.0) - 1.0))
    if blend > 0:
        value += ((_interpolate(pyramid, u, v, level + 1) - value) * blend) >> 8
    return value / 65536.0


@njit(cache=True)
def _interpolate(pyramid, u, v, level):
    """Return a level's grey value << 16 at (u, v), bilinear, in integers."""
    bits = TEXTURE_BITS - level
    wrap = (1 << bits) - 1
    fixed_u = int(math.floor(u * 256.0 / (1 << level))) - 128
    fixed_v = int(math.floor(v * 256.0 / (1 << level))) - 128
    left, top = (fixed_u >> 8) & wrap, (fixed_v >> 8) & wrap
    right, bottom = (left + 1) & wrap, (top + 1) & wrap
    upper = LEVEL_STARTS[level] + (top << bits)
    lower = LEVEL_STARTS[level] + (bottom << bits)
    weight_u, weight_v = fixed_u & 255, fixed_v & 255
    above = pyramid[upper + left] * (256 - weight_u) + pyramid[upper + right] * weight_u
    below = pyramid[lower + left] * (256 - weight_u) + pyramid[lower + right] * weight_u
    return above * (256 - weight_v) + below * weight_v


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
