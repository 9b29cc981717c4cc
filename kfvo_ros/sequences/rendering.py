# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A ray caster for rooms full of textured boxes, whose bytes are the same on every machine.

In a pinhole image the inverse depth of a plane is a linear function of the pixel. A box is then
six linear functions: the ray enters it at the smallest inverse depth over the planes that face
the camera and leaves it at the largest over the others.

Bytes repeat because nothing here depends on a maths library or on the order of a reduction:
float64 sums, products, quotients and square roots (which IEEE 754 defines to the last bit, and
which Numba does not fuse without fastmath), then integers from the texels on.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from kfvo_ros.camera import Camera

TEXTURE_BITS = 9
TEXTURE_SIZE = 1 << TEXTURE_BITS
"""Textures are square, repeat in both directions and have this many texels a side."""
LEVEL_STARTS = np.array([(4 ** (TEXTURE_BITS + 1) - 4 ** (TEXTURE_BITS + 1 - level)) // 3
                         for level in range(TEXTURE_BITS + 2)])
"""Where each level of a texture's pyramid starts, the finest first; then the total length."""

FACE = np.dtype([('texture', np.int32), ('scale_u', np.float64), ('scale_v', np.float64),
                 ('offset_u', np.float64), ('offset_v', np.float64),
                 ('bias', np.float64), ('contrast', np.float64)])
"""How a face is painted: the texel at scale [1/m] * place on the face + offset is taken, and
bias + contrast * texel is the grey value under full light."""

TILE = 16
"""Boxes are sorted out for squares of so many pixels."""
AMBIENT, DIFFUSE, LIGHT_RANGE = 0.65, 0.8, 3.0
"""Light: a constant and what the lamp adds, which is halved at this distance [m]."""
RADIANCE_BITS, GAIN_BITS, NOISE_BITS = 6, 10, 20
"""Binary digits after the point of radiances, of the camera's gain and of the grey value."""
NOISE_SCALE = 10032
"""Makes a sum of eight random bytes (sigma 209.02) noise of sigma 2 grey values."""

_WEYL, _MIX = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xD6E8FEB86659FD93)
_SPREAD = 0xD1342543DE82EF95
"""Keeps the counters of one noise key far from those of the next."""
_HALF, _BYTE, _TOP = np.uint64(32), np.uint64(8), np.uint64(48)
_EVEN_BYTES, _ADD_UP = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0001000100010001)


class Scene(NamedTuple):
    """Boxes that stand upright in a world with z up [m]; the first is the room, from inside.

    ``turns`` (K, 2) cosine and sine of each box's heading, ``centres`` (K, 3), ``halves``
    (K, 3) half sizes, ``faces`` (K, 6) FACE in the order -x +x -y +y -z +z of the box's own
    axes, ``pyramids`` (N, LEVEL_STARTS[-1]) uint8, ``lamp`` (3,).
    """

    turns: np.ndarray
    centres: np.ndarray
    halves: np.ndarray
    faces: np.ndarray
    pyramids: np.ndarray
    lamp: np.ndarray


def render(scene: Scene, camera: Camera, T_world_camera: np.ndarray
           ) -> tuple[np.ndarray, np.ndarray]:
    """Return radiance (H, W) int32 (grey values << RADIANCE_BITS) and depth (H, W) [m].

    Depth is measured along the optical axis. `camera` is a pinhole with square pixels.
    """
    radiance = np.empty((camera.height, camera.width), dtype=np.int32)
    hits, depth = np.empty_like(radiance), np.empty(radiance.shape)
    rays, origins = _in_box_frames(scene, T_world_camera, camera.fx, camera.cx, camera.cy)
    _cast(*_inverse_depths(scene, rays, origins), hits, depth)
    _shade(scene, rays, origins, camera.fx, hits, depth, radiance)
    return radiance, depth


def expose(radiance: np.ndarray, gain: float, noise_key: int) -> np.ndarray:
    """Return the image (H, W) uint8 of a lens and sensor: blur, gain, noise of sigma 2.

    `noise_key` (64 bits) selects the noise; the gain is rounded to GAIN_BITS.
    """
    image = np.empty(radiance.shape, dtype=np.uint8)
    _expose(radiance, round(gain * (1 << GAIN_BITS)), np.uint64(noise_key * _SPREAD % 2 ** 64), image)
    return image


@njit(cache=True)
def _in_box_frames(scene, T_world_camera, focal, cx, cy):
    """Return, per box, rays (K, 3, 3) with direction = rays @ (u, v, 1), and the camera (K, 3).

    Directions have length one along the optical axis, so that points are origin + depth * ray.
    """
    count = len(scene.centres)
    rays, origins = np.empty((count, 3, 3)), np.empty((count, 3))
    for box in range(count):
        cosine, sine = scene.turns[box, 0], scene.turns[box, 1]
        centre = scene.centres[box]
        for column in range(4):
            x, y, z = T_world_camera[0, column], T_world_camera[1, column], T_world_camera[2, column]
            if column == 3:
                x, y, z = x - centre[0], y - centre[1], z - centre[2]
            turned = (cosine * x + sine * y, cosine * y - sine * x, z)
            for axis in range(3):
                if column == 3:
                    origins[box, axis] = turned[axis]
                else:
                    rays[box, axis, column] = turned[axis]
        for axis in range(3):
            right, down = rays[box, axis, 0] / focal, rays[box, axis, 1] / focal
            rays[box, axis, 2] -= right * cx + down * cy
            rays[box, axis, 0], rays[box, axis, 1] = right, down
    return rays, origins


@njit(cache=True)
def _inverse_depths(scene, rays, origins):
    """Return, per box, its planes as inverse depth = planes (K, 6, 3) @ (u, v, 1).

    Planes by which a ray enters the box come first: entries (K,) of them. sides (K, 6) says
    which face each plane is.
    """
    count = len(origins)
    planes, sides = np.empty((count, 6, 3)), np.empty((count, 6), dtype=np.int32)
    entries = np.zeros(count, dtype=np.int32)
    for box in range(count):
        last = 5
        for side in range(6):
            axis, sign = side // 2, 2.0 * (side % 2) - 1.0
            distance = sign * scene.halves[box, axis] - origins[box, axis]
            if abs(distance) < 1e-9:
                distance = 1e-9
            if sign * distance < 0.0:
                place = entries[box]
                entries[box] += 1
            else:
                place = last
                last -= 1
            sides[box, place] = side
            for column in range(3):
                planes[box, place, column] = rays[box, axis, column] / distance
    return planes, sides, entries


@njit(cache=True)
def _cast(planes, sides, entries, hits, depth):
    """Find what every pixel sees: hits (6 * box + side) and depth."""
    height, width = depth.shape
    candidates = np.empty(len(planes), dtype=np.int32)
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            count = _boxes_in_tile(planes, entries, left, top, candidates)
            for v in range(top, min(top + TILE, height)):
                for u in range(left, min(left + TILE, width)):
                    hits[v, u], inverse = _nearest(planes, sides, entries, candidates, count,
                                                   u, v)
                    depth[v, u] = 1.0 / inverse


@njit(cache=True)
def _boxes_in_tile(planes, entries, left, top, candidates):
    """Write the boxes that a tile may see to `candidates` and return their number.

    The room is always seen and never listed.
    """
    reach = 0.5 * (TILE - 1)
    u, v = left + reach, top + reach
    count = 0
    for box in range(1, len(planes)):
        enters, leaves = math.inf, 0.0
        for place in range(6):
            inverse = _at(planes, box, place, u, v)
            slack = (abs(planes[box, place, 0]) + abs(planes[box, place, 1])) * reach
            if place < entries[box]:
                enters = min(enters, inverse + slack)
            else:
                leaves = max(leaves, inverse - slack)
        if leaves < enters < math.inf:
            candidates[count] = box
            count += 1
    return count


@njit(cache=True)
def _nearest(planes, sides, entries, candidates, count, u, v):
    """Return what a pixel sees (6 * box + side) and its inverse depth."""
    nearest, hit = 0.0, 0
    for place in range(6):
        inverse = _at(planes, 0, place, u, v)
        if inverse > nearest:
            nearest, hit = inverse, sides[0, place]
    for box in candidates[:count]:
        enters, leaves, entry = math.inf, nearest, 0
        for place in range(entries[box]):
            inverse = _at(planes, box, place, u, v)
            if inverse < enters:
                enters, entry = inverse, place
        if enters > nearest:
            for place in range(entries[box], 6):
                leaves = max(leaves, _at(planes, box, place, u, v))
            if enters > leaves:
                nearest, hit = enters, 6 * box + sides[box, entry]
    return hit, nearest


@njit(cache=True)
def _at(planes, box, place, u, v):
    """Return the inverse depth of a plane at a pixel."""
    return planes[box, place, 0] * u + planes[box, place, 1] * v + planes[box, place, 2]


@njit(cache=True)
def _shade(scene, rays, origins, focal, hits, depth, radiance):
    """Fill in the radiance of what every pixel sees."""
    faces, turns, centres, pyramids = scene.faces, scene.turns, scene.centres, scene.pyramids
    lamp_x, lamp_y, lamp_z = scene.lamp
    height, width = hits.shape
    for v in range(height):
        for u in range(width):
            box, side = hits[v, u] // 6, hits[v, u] % 6
            ray_x = rays[box, 0, 0] * u + rays[box, 0, 1] * v + rays[box, 0, 2]
            ray_y = rays[box, 1, 0] * u + rays[box, 1, 1] * v + rays[box, 1, 2]
            ray_z = rays[box, 2, 0] * u + rays[box, 2, 1] * v + rays[box, 2, 2]
            x = origins[box, 0] + depth[v, u] * ray_x
            y = origins[box, 1] + depth[v, u] * ray_y
            z = origins[box, 2] + depth[v, u] * ray_z
            if side < 2:
                across, down, facing = y, -z, ray_x
            elif side < 4:
                across, down, facing = x, -z, ray_y
            else:
                across, down, facing = x, y, ray_z
            face = faces[box, side]
            # A pixel covers depth / focal on a surface seen squarely and more, one way, on a
            # slanted one; the geometric mean of both is between blur and aliasing.
            length = math.sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z)
            footprint = depth[v, u] / focal * math.sqrt(length / max(abs(facing), 0.02))
            texel = _sample(pyramids, face.texture, across * face.scale_u + face.offset_u,
                            down * face.scale_v + face.offset_v,
                            footprint * max(face.scale_u, face.scale_v))
            x, y = turns[box, 0] * x - turns[box, 1] * y, turns[box, 1] * x + turns[box, 0] * y
            x += centres[box, 0] - lamp_x
            y += centres[box, 1] - lamp_y
            z += centres[box, 2] - lamp_z
            light = AMBIENT + DIFFUSE / (
                1.0 + (x * x + y * y + z * z) / (LIGHT_RANGE * LIGHT_RANGE))
            radiance[v, u] = int((face.bias + face.contrast * texel) * light
                                 * (1 << RADIANCE_BITS))


@njit(cache=True)
def _sample(pyramids, texture, u, v, footprint):
    """Return the grey value of a texture where a pixel covers `footprint` of its texels.

    Trilinear, in integers: bilinear in the two nearest levels of the pyramid.
    """
    level = 0
    while footprint >= 2.0 and level < TEXTURE_BITS - 2:
        footprint *= 0.5
        level += 1
    value = _bilinear(pyramids, texture, u, v, level)
    blend = int(256.0 * (min(footprint, 2.0) - 1.0))
    if blend > 0:
        value += ((_bilinear(pyramids, texture, u, v, level + 1) - value) * blend) >> 8
    return value / 65536.0


@njit(cache=True)
def _bilinear(pyramids, texture, u, v, level):
    """Return a level's grey value << 16 at (u, v) in texels of the finest level."""
    bits = TEXTURE_BITS - level
    wrap = (1 << bits) - 1
    fixed_u = int(math.floor(u * 256.0 / (1 << level))) - 128
    fixed_v = int(math.floor(v * 256.0 / (1 << level))) - 128
    left, top = (fixed_u >> 8) & wrap, (fixed_v >> 8) & wrap
    right, bottom = (left + 1) & wrap, (top + 1) & wrap
    upper = LEVEL_STARTS[level] + (top << bits)
    lower = LEVEL_STARTS[level] + (bottom << bits)
    weight_u, weight_v = fixed_u & 255, fixed_v & 255
    above = (pyramids[texture, upper + left] * (256 - weight_u)
             + pyramids[texture, upper + right] * weight_u)
    below = (pyramids[texture, lower + left] * (256 - weight_u)
             + pyramids[texture, lower + right] * weight_u)
    return above * (256 - weight_v) + below * weight_v


@njit(cache=True)
def _expose(radiance, gain, noise_key, image):
    """Blur by a 3x3 binomial, amplify, add noise, round and clip, all in integers."""
    height, width = radiance.shape
    rows = np.empty(width + 2, dtype=np.int64)
    rounding = 1 << (NOISE_BITS - 1)
    for v in range(height):
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        for u in range(width):
            rows[u + 1] = radiance[above, u] + 2 * radiance[v, u] + radiance[below, u]
        rows[0], rows[width + 1] = rows[1], rows[width]
        for u in range(width):
            blurred = rows[u] + 2 * rows[u + 1] + rows[u + 2]
            value = blurred * gain + rounding
            value += NOISE_SCALE * _noise(noise_key, v * width + u)
            image[v, u] = min(max(value >> NOISE_BITS, 0), 255)


@njit(cache=True)
def _noise(key, counter):
    """Return the centred sum of eight random bytes, nearly normal, of a counter's hash."""
    bits = (key + np.uint64(counter)) * _WEYL
    bits = (bits ^ (bits >> _HALF)) * _MIX
    bits = (bits ^ (bits >> _HALF)) * _MIX
    pairs = (bits & _EVEN_BYTES) + ((bits >> _BYTE) & _EVEN_BYTES)
    return np.int64((pairs * _ADD_UP) >> _TOP) - 1020
