# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scene of a rendered sequence: upright textured boxes and one point light, and its builder."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from kfvo_ros.sequences.synthetic.rng import StableRng

Vec3 = tuple[float, float, float]
Heading = tuple[float, float]
"""Cosine and sine of the angle about z."""
TEXTURE_BITS = 9
TEXTURE_SIZE = 1 << TEXTURE_BITS
"""Texels along a side of the finest mip level."""
FACE_DTYPE = np.dtype([('texture', np.int32), ('scale_u', np.float64), ('scale_v', np.float64),
                       ('offset_u', np.float64), ('offset_v', np.float64),
                       ('bias', np.float64), ('contrast', np.float64)])
"""Material of a face: reflectance = bias + contrast * texel, with texture coordinates
[texel] = scale [texel/m] * position from the middle of the face [m] + offset."""
TEXELS_PER_METRE = 230.0
EXTERIOR_SHADES = (0.90, 0.78, 0.84, 0.96, 0.50, 1.05)
INTERIOR_SHADES = (0.95, 0.88, 0.92, 1.00, 0.90, 1.00)
"""Share of the light that the faces -x +x -y +y -z +z of a box, and of the enclosing room,
receive."""


class Scene(NamedTuple):
    """K upright boxes in a world with z up [m]; the first is the room, seen from inside.

    ``headings`` (K, 2) cosine and sine of each box's heading, ``centres`` (K, 3),
    ``half_sizes`` (K, 3), ``faces`` (K, 6) FACE_DTYPE in the order -x +x -y +y -z +z of the
    box's axes, ``mipmaps`` (N, -1) uint8 as `build_mipmap` returns them, ``light`` (3,) the
    position of the light.
    """

    headings: np.ndarray
    centres: np.ndarray
    half_sizes: np.ndarray
    faces: np.ndarray
    mipmaps: np.ndarray
    light: np.ndarray


class SceneBuilder:
    """Collects upright boxes, the enclosing room first, and their textures."""

    def __init__(self, rng: StableRng, texels_per_metre: float = TEXELS_PER_METRE) -> None:
        self._rng, self._texels_per_metre = rng, texels_per_metre
        self._headings: list[Heading] = []
        self._centres: list[Vec3] = []
        self._half_sizes: list[Vec3] = []
        self._faces: list[np.ndarray] = []
        self._mipmaps: list[np.ndarray] = []

    def add_texture(self, generate: Callable[[StableRng], np.ndarray]) -> int:
        """Generate a texture and return its index."""
        self._mipmaps.append(build_mipmap(generate(self._rng)))
        return len(self._mipmaps) - 1

    def add_box(self, texture: int, centre: Vec3, size: Vec3, heading: Heading = (1.0, 0.0),
                contrast: float = 1.0, brightness: float = 0.0, stretch: bool = False) -> None:
        """Add a box with one texture, repeated at its own scale or `stretch`-ed over each face.

        `contrast` and `brightness` as in `set_material`.
        """
        self._headings.append(heading)
        self._centres.append(centre)
        self._half_sizes.append((0.5 * size[0], 0.5 * size[1], 0.5 * size[2]))
        self._faces.append(np.zeros(6, dtype=FACE_DTYPE))
        for side, face in enumerate(self._faces[-1]):
            axis_u, axis_v = ((1, 2), (0, 2), (0, 1))[side // 2]
            for axis, scale, offset in ((axis_u, 'scale_u', 'offset_u'),
                                        (axis_v, 'scale_v', 'offset_v')):
                face[scale] = (TEXTURE_SIZE / size[axis] if stretch
                               else self._texels_per_metre)
                face[offset] = (0.5 * TEXTURE_SIZE if stretch
                                else self._rng.integer(0, TEXTURE_SIZE))
            self.set_material(len(self._faces) - 1, side, texture, contrast, brightness)

    def set_material(self, box: int, side: int, texture: int, contrast: float,
                     brightness: float) -> None:
        """Set the texture of one side of a box.

        In full light the texel 128 becomes 128 + brightness; `contrast` scales the difference
        of the others from it.
        """
        shade = (EXTERIOR_SHADES if box else INTERIOR_SHADES)[side]
        face = self._faces[box][side]
        face['texture'] = texture
        face['contrast'] = contrast * shade
        face['bias'] = (128.0 + brightness - 128.0 * contrast) * shade

    def build(self, light: Vec3) -> Scene:
        """Return the scene, with a light at a position [m]."""
        return Scene(np.array(self._headings), np.array(self._centres),
                     np.array(self._half_sizes), np.stack(self._faces), np.stack(self._mipmaps),
                     np.array(light))


def build_mipmap(texture: np.ndarray) -> np.ndarray:
    """Return all mip levels, the finest first, flat and uint8, of a texture.

    The texture holds grey values (TEXTURE_SIZE, TEXTURE_SIZE); every level halves the last.
    """
    level: np.ndarray = np.clip(np.floor(texture + 0.5), 0.0, 255.0).astype(np.uint16)
    levels = [level.ravel()]
    for _ in range(TEXTURE_BITS):
        level = (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2]
                 + 2) >> 2
        levels.append(level.ravel())
    return np.concatenate(levels).astype(np.uint8)


def distance_to_box(points: np.ndarray, centre: Vec3, size: Vec3, heading: Heading
                    ) -> np.ndarray:
    """Return the distances (N,) of points (N, 3) to an upright box, 0 inside [m]."""
    x, y, z = (points - np.array(centre)).T
    local = (heading[0] * x + heading[1] * y, heading[0] * y - heading[1] * x, z)
    beyond = [np.maximum(np.abs(value) - 0.5 * extent, 0.0)
              for value, extent in zip(local, size, strict=True)]
    return np.sqrt(beyond[0] * beyond[0] + beyond[1] * beyond[1] + beyond[2] * beyond[2])
