# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ray caster for scenes of textured boxes, whose bytes are the same on every machine.

In a pinhole image the inverse depth of a plane is a linear function of the pixel. A box is six
such functions: a ray enters it at the smallest inverse depth of the planes that face the camera,
and leaves it at the largest of the others.

Bytes repeat because nothing depends on a maths library or on the order of a sum: all float64
operations are defined to the last bit by IEEE 754 and kept in place by Numba without fastmath;
from the texels on, arithmetic is in integers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.sequences.synthetic.scene import Scene
from kfvo_ros.sequences.synthetic.shading import BoxFrameCamera, compiled, shade

TILE = 16
"""Boxes are culled per square tile of this side [px]."""


class _Planes(NamedTuple):
    """The planes of K boxes in an image.

    The inverse depth of a plane at pixel (u, v) is ``coefficients`` (K, 6, 3) @ (u, v, 1). The
    planes by which rays enter a box come first; ``entry_counts`` (K,) is their number.
    ``sides`` (K, 6) is the face of each plane.
    """

    coefficients: np.ndarray
    entry_counts: np.ndarray
    sides: np.ndarray


def render(scene: Scene, camera: Camera, T_world_camera: np.ndarray
           ) -> tuple[np.ndarray, np.ndarray]:
    """Return radiance (H, W) int32, as `shading.shade` writes it, and depth (H, W) [m].

    Depth is measured along the optical axis. `camera` is a pinhole with square pixels.
    """
    hits = np.empty((camera.height, camera.width), dtype=np.int32)
    radiance, depth = np.empty_like(hits), np.empty(hits.shape)
    rays, origins = _rays_in_box_frames(scene, T_world_camera, camera.fx, camera.cx, camera.cy)
    _cast_rays(_Planes(*_project_planes(scene.half_sizes, rays, origins)), hits, depth)
    shade(scene, BoxFrameCamera(rays, origins, camera.fx), hits, depth, radiance)
    return radiance, depth


@compiled
def _rays_in_box_frames(scene: Scene, T_world_camera: np.ndarray, focal: float, cx: float,
                        cy: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rays (K, 3, 3) and origins (K, 3) of BoxFrameCamera.

    A point at a depth is origin + depth * rays @ (u, v, 1).
    """
    count = len(scene.centres)
    axes, origins = np.empty((count, 3, 4)), np.empty((count, 3))
    rays = np.empty((count, 3, 3))
    for box in range(count):
        cosine, sine = scene.headings[box]
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


@compiled
def _project_planes(half_sizes: np.ndarray, rays: np.ndarray, origins: np.ndarray
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the fields of _Planes."""
    count = len(origins)
    coefficients, sides = np.empty((count, 6, 3)), np.empty((count, 6), dtype=np.int32)
    entry_counts = np.zeros(count, dtype=np.int32)
    for box in range(count):
        last = 5
        for side in range(6):
            axis, sign = side // 2, 2.0 * (side % 2) - 1.0
            distance = sign * half_sizes[box, axis] - origins[box, axis]
            if abs(distance) < 1e-9:
                distance = 1e-9
            if sign * distance < 0.0:
                plane = entry_counts[box]
                entry_counts[box] += 1
            else:
                plane = last
                last -= 1
            sides[box, plane] = side
            for column in range(3):
                coefficients[box, plane, column] = rays[box, axis, column] / distance
    return coefficients, entry_counts, sides


@compiled
def _cast_rays(planes: _Planes, hits: np.ndarray, depth: np.ndarray) -> None:
    """Write the hit buffer, 6 * box + side per pixel, and its depth, tile by tile."""
    height, width = depth.shape
    visible = np.empty(len(planes.entry_counts), dtype=np.int32)
    inverse_depth, hit = np.empty(TILE), np.empty(TILE, dtype=np.int32)
    scratch = np.empty(TILE), np.empty(TILE), np.empty(TILE, dtype=np.int32)
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            count = _cull_boxes(planes, left, top, visible)
            for v in range(top, min(top + TILE, height)):
                _intersect_room(planes, left, v, inverse_depth, hit)
                for index in range(count):
                    _intersect_box(planes, visible[index], left, v, inverse_depth, hit, scratch)
                for u in range(min(TILE, width - left)):
                    hits[v, left + u] = hit[u]
                    depth[v, left + u] = 1.0 / inverse_depth[u]


@compiled
def _cull_boxes(planes: _Planes, left: int, top: int, visible: np.ndarray) -> int:
    """Write the boxes that a tile may see, without the room; return their number."""
    reach = 0.5 * (TILE - 1)
    u, v = left + reach, top + reach
    count = 0
    for box in range(1, len(planes.entry_counts)):
        near, far = math.inf, 0.0
        for plane in range(6):
            right, down = planes.coefficients[box, plane, 0], planes.coefficients[box, plane, 1]
            middle = right * u + down * v + planes.coefficients[box, plane, 2]
            slack = (abs(right) + abs(down)) * reach
            if plane < planes.entry_counts[box]:
                near = min(near, middle + slack)
            else:
                far = max(far, middle - slack)
        if far < near < math.inf:
            visible[count] = box
            count += 1
    return count


@compiled
def _intersect_room(planes: _Planes, left: int, v: int, inverse_depth: np.ndarray,
                    hit: np.ndarray) -> None:
    """Write the walls that a row of a tile hits, and their inverse depths."""
    inverse_depth[:] = 0.0
    for plane in range(6):
        slope, start = _along_row(planes, 0, plane, left, v)
        for u in range(TILE):
            value = start + slope * u
            hit[u] = planes.sides[0, plane] if value > inverse_depth[u] else hit[u]
            inverse_depth[u] = max(inverse_depth[u], value)


@compiled
def _intersect_box(planes: _Planes, box: int, left: int, v: int, inverse_depth: np.ndarray,
                   hit: np.ndarray, scratch: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    """Overwrite the hits of a row of a tile where a box is nearer."""
    near, far, near_face = scratch
    near[:], far[:] = math.inf, inverse_depth
    for plane in range(6):
        slope, start = _along_row(planes, box, plane, left, v)
        if plane < planes.entry_counts[box]:
            face = 6 * box + planes.sides[box, plane]
            for u in range(TILE):
                value = start + slope * u
                near_face[u] = face if value < near[u] else near_face[u]
                near[u] = min(near[u], value)
        else:
            for u in range(TILE):
                far[u] = max(far[u], start + slope * u)
    for u in range(TILE):
        hit[u] = near_face[u] if near[u] > far[u] else hit[u]
        inverse_depth[u] = near[u] if near[u] > far[u] else inverse_depth[u]


@compiled
def _along_row(planes: _Planes, box: int, plane: int, left: int, v: int) -> tuple[float, float]:
    """Return the slope of a plane's inverse depth along a row, and its value at `left`."""
    right, down, start = planes.coefficients[box, plane]
    return right, right * left + down * v + start
