# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Putting painted boxes together to a scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kfvo_ros.sequences.synthetic.renderer import Scene
from kfvo_ros.sequences.synthetic.rng import StableRng
from kfvo_ros.sequences.synthetic.shading import FACE, TEXTURE_SIZE, build_pyramid

Size = tuple[float, float, float]
Turn = tuple[float, float]
"""Cosine and sine of a heading."""
TEXELS_PER_METRE = 230.0
SHADES_OUTSIDE = (0.90, 0.78, 0.84, 0.96, 0.50, 1.05)
SHADES_INSIDE = (0.95, 0.88, 0.92, 1.00, 0.90, 1.00)
"""Light that the faces -x +x -y +y -z +z of a box, and of the room, receive."""


class BoxCollector:
    """Collects upright boxes, the room or the world first, and the textures that they wear."""

    def __init__(self, rng: StableRng, texels_per_metre: float = TEXELS_PER_METRE) -> None:
        self._rng, self._texels_per_metre = rng, texels_per_metre
        self._turns: list[Turn] = []
        self._centres: list[Size] = []
        self._halves: list[Size] = []
        self._faces: list[np.ndarray] = []
        self._pyramids: list[np.ndarray] = []

    def texture(self, painter: Callable[[StableRng], np.ndarray]) -> int:
        """Paint a new texture and return its number."""
        self._pyramids.append(build_pyramid(painter(self._rng)))
        return len(self._pyramids) - 1

    def add(self, texture: int, centre: Size, size: Size, turn: Turn = (1.0, 0.0),
            contrast: float = 1.0, tone: float = 0.0, fitted: bool = False) -> None:
        """Add a box with one texture, laid in its own scale or `fitted` to every side once."""
        self._turns.append(turn)
        self._centres.append(centre)
        self._halves.append((0.5 * size[0], 0.5 * size[1], 0.5 * size[2]))
        self._faces.append(np.zeros(6, dtype=FACE))
        for side, face in enumerate(self._faces[-1]):
            across, down = ((1, 2), (0, 2), (0, 1))[side // 2]
            for axis, scale, offset in ((across, 'scale_u', 'offset_u'),
                                        (down, 'scale_v', 'offset_v')):
                face[scale] = (TEXTURE_SIZE / size[axis] if fitted
                               else self._texels_per_metre)
                face[offset] = (0.5 * TEXTURE_SIZE if fitted
                                else self._rng.integer(0, TEXTURE_SIZE))
            self.paint(len(self._faces) - 1, side, texture, contrast, tone)

    def paint(self, box: int, side: int, texture: int, contrast: float, tone: float) -> None:
        """Give one side of a box another texture.

        The texel 128 becomes 128 + tone in full light; others differ from it by `contrast`.
        """
        shade = (SHADES_OUTSIDE if box else SHADES_INSIDE)[side]
        face = self._faces[box][side]
        face['texture'] = texture
        face['contrast'] = contrast * shade
        face['bias'] = (128.0 + tone - 128.0 * contrast) * shade

    def build(self, lamp: Size) -> Scene:
        """Return what was collected, lit by a lamp."""
        return Scene(np.array(self._turns), np.array(self._centres), np.array(self._halves),
                     np.stack(self._faces), np.stack(self._pyramids), np.array(lamp))


def distance_to_box(points: np.ndarray, centre: Size, size: Size, turn: Turn) -> np.ndarray:
    """Return the distances (N,) of points (N, 3) to an upright box, 0 inside [m]."""
    x, y, z = (points - np.array(centre)).T
    local = (turn[0] * x + turn[1] * y, turn[0] * y - turn[1] * x, z)
    beyond = [np.maximum(np.abs(value) - 0.5 * extent, 0.0)
              for value, extent in zip(local, size, strict=True)]
    return np.sqrt(beyond[0] * beyond[0] + beyond[1] * beyond[1] + beyond[2] * beyond[2])
