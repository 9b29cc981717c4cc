# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A ray caster for rooms full of textured boxes, whose bytes are the same on every machine.

In a pinhole image the inverse depth of a plane is a linear function of the pixel. A box is then
six linear functions: a ray enters it at the smallest inverse depth over the planes that face
the camera, and leaves it at the largest over the others.

Bytes repeat because nothing depends on a maths library or on the order of a sum: there are only
float64 operations that IEEE 754 defines to the last bit and that Numba leaves in place without
fastmath, then integers from the texels on.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from kfvo_ros.camera import Camera
from kfvo_ros.sequences.synthetic.shading import BoxFrameCamera, shade

TILE = 16
"""Boxes are sorted out for squares of so many pixels."""


class Scene(NamedTuple):
    """Upright boxes in a world with z up [m]; the first is the room, seen from inside.

    ``turns`` (K, 2) cosine and sine of each box's heading, ``centres`` (K, 3), ``halves``
    (K, 3) half sizes, ``faces`` (K, 6) shading.FACE in the order -x +x -y +y -z +z of the box's
    axes, ``pyramids`` (N, -1) uint8 as shading.build_pyramid returns them, ``lamp`` (3,).
    """

    turns: np.ndarray
    centres: np.ndarray
    halves: np.ndarray
    faces: np.ndarray
    pyramids: np.ndarray
    lamp: np.ndarray


class _Planes(NamedTuple):
    """The planes of all boxes in an image.

    inverse depth = ``slopes`` (K, 6, 3) @ (u, v, 1). The planes by which rays enter a box come
    first, ``entries`` (K,) of them; ``sides`` (K, 6) says which face each plane is.
    """

    slopes: np.ndarray
    entries: np.ndarray
    sides: np.ndarray


def render(scene: Scene, camera: Camera, T_world_camera: np.ndarray
           ) -> tuple[np.ndarray, np.ndarray]:
    """Return radiance (H, W) int32, as `shading.shade` writes it, and depth (H, W) [m].

    Depth is measured along the optical axis. `camera` is a pinhole with square pixels.
    """
    hits = np.empty((camera.height, camera.width), dtype=np.int32)
    radiance, depth = np.empty_like(hits), np.empty(hits.shape)
    rays, origins = _in_box_frames(scene, T_world_camera, camera.fx, camera.cx, camera.cy)
    _cast(_Planes(*_find_planes(scene.halves, rays, origins)), hits, depth)
    shade(scene, BoxFrameCamera(rays, origins, camera.fx), hits, depth, radiance)
    return radiance, depth


@njit(cache=True)
def _in_box_frames(scene, T_world_camera, focal, cx, cy):
    """Return, per box, rays (K, 3, 3) with direction = rays @ (u, v, 1), and the camera (K, 3).

    Directions have length one along the optical axis: points are camera + depth * direction.
    """
    count = len(scene.centres)
    axes, origins = np.empty((count, 3, 4)), np.empty((count, 3))
    rays = np.empty((count, 3, 3))
    for box in range(count):
        cosine, sine = scene.turns[box]
        for column in range(4):
            x, y, z = T_world_camera[:3, column]
            if column == 3:
                x -= scene.centres[box, 0]
                y -= scene.centres[box, 1]
                z -= scene.centres[box, 2]
            axes[box, 0, column] = cosine * x + sine * y
            axes[box, 1, column] = cosine * y - sine * x
            axes[box, 2, column] = z
        for axis in range(3):
            right, down = axes[box, axis, 0] / focal, axes[box, axis, 1] / focal
            rays[box, axis, 0], rays[box, axis, 1] = right, down
            rays[box, axis, 2] = axes[box, axis, 2] - right * cx - down * cy
            origins[box, axis] = axes[box, axis, 3]
    return rays, origins


@njit(cache=True)
def _find_planes(halves, rays, origins):
    """Return the members of _Planes."""
    count = len(origins)
    slopes, sides = np.empty((count, 6, 3)), np.empty((count, 6), dtype=np.int32)
    entries = np.zeros(count, dtype=np.int32)
    for box in range(count):
        last = 5
        for side in range(6):
            axis, sign = side // 2, 2.0 * (side % 2) - 1.0
            distance = sign * halves[box, axis] - origins[box, axis]
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
                slopes[box, place, column] = rays[box, axis, column] / distance
    return slopes, entries, sides


@njit(cache=True)
def _cast(planes, hits, depth):
    """Find what every pixel sees, hits (6 * box + side), and how far away, tile by tile."""
    height, width = depth.shape
    listed = np.empty(len(planes.entries), dtype=np.int32)
    inverse, hit = np.empty(TILE), np.empty(TILE, dtype=np.int32)
    scratch = np.empty(TILE), np.empty(TILE), np.empty(TILE, dtype=np.int32)
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            count = _list_boxes(planes, left, top, listed)
            for v in range(top, min(top + TILE, height)):
                _see_room(planes, left, v, inverse, hit)
                for place in range(count):
                    _see_box(planes, listed[place], left, v, inverse, hit, scratch)
                for u in range(min(TILE, width - left)):
                    hits[v, left + u] = hit[u]
                    depth[v, left + u] = 1.0 / inverse[u]


@njit(cache=True)
def _list_boxes(planes, left, top, listed):
    """Write the boxes that a tile may see, but for the room; return their number."""
    reach = 0.5 * (TILE - 1)
    u, v = left + reach, top + reach
    count = 0
    for box in range(1, len(planes.entries)):
        enters, leaves = math.inf, 0.0
        for place in range(6):
            right, down = planes.slopes[box, place, 0], planes.slopes[box, place, 1]
            middle = right * u + down * v + planes.slopes[box, place, 2]
            slack = (abs(right) + abs(down)) * reach
            if place < planes.entries[box]:
                enters = min(enters, middle + slack)
            else:
                leaves = max(leaves, middle - slack)
        if leaves < enters < math.inf:
            listed[count] = box
            count += 1
    return count


@njit(cache=True)
def _see_room(planes, left, v, inverse, hit):
    """Write the wall that a row of a tile sees and its inverse depth."""
    inverse[:] = 0.0
    for place in range(6):
        slope, start = _along_row(planes, 0, place, left, v)
        for u in range(TILE):
            value = start + slope * u
            hit[u] = planes.sides[0, place] if value > inverse[u] else hit[u]
            inverse[u] = max(inverse[u], value)


@njit(cache=True)
def _see_box(planes, box, left, v, inverse, hit, scratch):
    """Put a box where it is nearer than what a row of a tile has seen."""
    enters, leaves, entry = scratch
    enters[:], leaves[:] = math.inf, inverse
    for place in range(6):
        slope, start = _along_row(planes, box, place, left, v)
        if place < planes.entries[box]:
            face = 6 * box + planes.sides[box, place]
            for u in range(TILE):
                value = start + slope * u
                entry[u] = face if value < enters[u] else entry[u]
                enters[u] = min(enters[u], value)
        else:
            for u in range(TILE):
                leaves[u] = max(leaves[u], start + slope * u)
    for u in range(TILE):
        hit[u] = entry[u] if enters[u] > leaves[u] else hit[u]
        inverse[u] = enters[u] if enters[u] > leaves[u] else inverse[u]


@njit(cache=True)
def _along_row(planes, box, place, left, v):
    """Return how a plane's inverse depth changes along a row and what it is at `left`."""
    right, down, start = planes.slopes[box, place]
    return right, right * left + down * v + start
