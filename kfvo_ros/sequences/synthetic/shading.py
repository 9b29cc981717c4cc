# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Shading of rendered images: trilinear textures, one point light, and a sensor model.

Radiances and grey values are fixed-point integers, so that their bytes are the same on every
machine.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kfvo_ros.sequences.synthetic.scene import TEXTURE_BITS, Scene
from kfvo_ros.utils.compiler import Compiler

compiled = Compiler(Path(__file__).parent)
"""Decorator for the functions of the renderer. Fast arithmetic would not repeat to the byte."""

MIP_OFFSETS = np.array([(4 ** (TEXTURE_BITS + 1) - 4 ** (TEXTURE_BITS + 1 - level)) // 3
                        for level in range(TEXTURE_BITS + 1)])
"""Start of each mip level in what `scene.build_mipmap` returns."""
RADIANCE_BITS = 6
"""Fractional bits of radiances, which are grey values."""
AMBIENT, DIFFUSE, LIGHT_RANGE = 0.65, 0.7, 3.0
"""Ambient light, and light of the lamp, which falls to half at LIGHT_RANGE [m]."""
GAIN_BITS = 10
"""Fractional bits of the gain."""
VALUE_BITS = RADIANCE_BITS + 4 + GAIN_BITS
"""Fractional bits of a grey value after blur (a sum of weight 16) and gain."""
NOISE_SCALE = round(2.0 * (1 << VALUE_BITS) / 209.02)
"""Scales a sum of eight random bytes, of standard deviation 209.02, to 2 grey values."""
_FRAME_STRIDE = 0xD1342543DE82EF95
"""Separates the pixel counters of successive frames."""
_WEYL, _MIX = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xD6E8FEB86659FD93)
_EVEN_BYTES, _SUM_OF_PAIRS = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0001000100010001)
_32, _8, _48 = np.uint64(32), np.uint64(8), np.uint64(48)


class BoxFrameCamera(NamedTuple):
    """A camera in the frame of each box.

    The ray of pixel (u, v) is ``rays`` (K, 3, 3) @ (u, v, 1), of length one along the optical
    axis, from ``origins`` (K, 3) [m]; ``focal`` [px].
    """

    rays: np.ndarray
    origins: np.ndarray
    focal: float


@compiled
def shade(scene: Scene, camera: BoxFrameCamera, hits: np.ndarray, depth: np.ndarray,
          radiance: np.ndarray) -> None:
    """Write the radiance (H, W) int32 of a hit buffer (H, W) at `depth` (H, W) [m].

    The hit buffer holds face numbers, 6 * box + side.
    """
    height, width = hits.shape
    samples = np.empty((4, width))
    for v in range(height):
        left = 0
        while left < width:
            hit, right = hits[v, left], left + 1
            while right < width and hits[v, right] == hit:
                right += 1
            _find_samples(scene, camera, hit // 6, hit % 6, v, left, right, depth, samples)
            face = scene.faces[hit // 6, hit % 6]
            bias, contrast, mipmap = face.bias, face.contrast, scene.mipmaps[face.texture]
            for u in range(left, right):
                texel = _sample_trilinear(mipmap, samples[0, u], samples[1, u], samples[2, u])
                radiance[v, u] = int((bias + contrast * texel) * samples[3, u])
            left = right


@compiled
def _find_samples(scene: Scene, camera: BoxFrameCamera, box: int, side: int, v: int, left: int,
                  right: int, depth: np.ndarray, samples: np.ndarray) -> None:
    """Write texture coordinates u and v, footprint [texel] and irradiance of a run of pixels.

    The run, `left` to `right` in row `v`, sees one face; `samples` is (4, W).
    """
    rays, face = camera.rays, scene.faces[box, side]
    origin_x, origin_y, origin_z = camera.origins[box]
    cosine, sine = scene.headings[box]
    centre_x, centre_y, centre_z = scene.centres[box]
    light_x, light_y, light_z = scene.light
    scale = max(face.scale_u, face.scale_v) / camera.focal
    for u in range(left, right):
        ray_x = rays[box, 0, 0] * u + rays[box, 0, 1] * v + rays[box, 0, 2]
        ray_y = rays[box, 1, 0] * u + rays[box, 1, 1] * v + rays[box, 1, 2]
        ray_z = rays[box, 2, 0] * u + rays[box, 2, 1] * v + rays[box, 2, 2]
        x = origin_x + depth[v, u] * ray_x
        y = origin_y + depth[v, u] * ray_y
        z = origin_z + depth[v, u] * ray_z
        face_u, face_v = y if side < 2 else x, -z if side < 4 else y
        samples[0, u] = face_u * face.scale_u + face.offset_u
        samples[1, u] = face_v * face.scale_v + face.offset_v
        # At normal incidence a pixel covers depth / focal; at an angle it covers more in one
        # direction. The geometric mean of both directions lies between blur and aliasing.
        normal = abs(ray_x if side < 2 else ray_y if side < 4 else ray_z)
        length = math.sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z)
        samples[2, u] = depth[v, u] * scale * math.sqrt(length / max(normal, 0.02))
        to_x = cosine * x - sine * y + centre_x - light_x
        to_y = sine * x + cosine * y + centre_y - light_y
        to_z = z + centre_z - light_z
        squared = (to_x * to_x + to_y * to_y + to_z * to_z) / (LIGHT_RANGE * LIGHT_RANGE)
        samples[3, u] = (AMBIENT + DIFFUSE / (1.0 + squared)) * (1 << RADIANCE_BITS)


@compiled
def _sample_trilinear(mipmap: np.ndarray, u: float, v: float, footprint: float) -> float:
    """Return the grey value at (u, v) of a pixel that covers `footprint` texels."""
    level = 0
    while footprint >= 2.0 and level < TEXTURE_BITS - 2:
        footprint *= 0.5
        level += 1
    value = _sample_bilinear(mipmap, u, v, level)
    blend = int(256.0 * (min(footprint, 2.0) - 1.0))
    if blend > 0:
        value += ((_sample_bilinear(mipmap, u, v, level + 1) - value) * blend) >> 8
    return value / 65536.0


@compiled
def _sample_bilinear(mipmap: np.ndarray, u: float, v: float, level: int) -> int:
    """Return the grey value << 16 of a mip level at (u, v), in integer arithmetic."""
    bits = TEXTURE_BITS - level
    wrap = (1 << bits) - 1
    fixed_u = int(math.floor(u * 256.0 / (1 << level))) - 128
    fixed_v = int(math.floor(v * 256.0 / (1 << level))) - 128
    left, top = (fixed_u >> 8) & wrap, (fixed_v >> 8) & wrap
    right, bottom = (left + 1) & wrap, (top + 1) & wrap
    upper = MIP_OFFSETS[level] + (top << bits)
    lower = MIP_OFFSETS[level] + (bottom << bits)
    weight_u, weight_v = fixed_u & 255, fixed_v & 255
    above = mipmap[upper + left] * (256 - weight_u) + mipmap[upper + right] * weight_u
    below = mipmap[lower + left] * (256 - weight_u) + mipmap[lower + right] * weight_u
    return above * (256 - weight_v) + below * weight_v


def simulate_sensor(radiance: np.ndarray, gain: float, noise_key: int) -> np.ndarray:
    """Return the image (H, W) uint8 of a radiance (H, W) as `renderer.render` returns it.

    The lens blurs by a 3x3 binomial kernel. Noise has a sigma of 2 grey values; `noise_key`,
    64 bits, seeds it.
    """
    image = np.empty(radiance.shape, dtype=np.uint8)
    key = np.uint64(noise_key * _FRAME_STRIDE % (1 << 64))
    _expose(radiance, round(gain * (1 << GAIN_BITS)), key, image)
    return image


@compiled
def _expose(radiance: np.ndarray, gain: int, noise_key: np.uint64, image: np.ndarray) -> None:
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
            noise = NOISE_SCALE * _pixel_noise(noise_key, v * width + u)
            image[v, u] = min(max((blurred * gain + noise + half) >> VALUE_BITS, 0), 255)


@compiled
def _pixel_noise(key: np.uint64, pixel: int) -> np.int64:
    """Return the sum of the eight bytes of a pixel's hash, centred: nearly normal."""
    bits = (key + np.uint64(pixel)) * _WEYL
    bits = (bits ^ (bits >> _32)) * _MIX
    bits = (bits ^ (bits >> _32)) * _MIX
    pairs = (bits & _EVEN_BYTES) + ((bits >> _8) & _EVEN_BYTES)
    return np.int64((pairs * _SUM_OF_PAIRS) >> _48) - 1020
