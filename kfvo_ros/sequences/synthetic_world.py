# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rendered room: what hangs on its walls and stands around in it, never in the way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kfvo_ros.sequences import synthetic_textures as textures
from kfvo_ros.sequences.rendering import FACE, TEXTURE_SIZE, Scene
from kfvo_ros.sequences.synthetic_textures import Dice

Size = tuple[float, float, float]

CLEARANCE = 0.45
"""Furniture keeps this far from the camera's path [m]."""
TEXELS_PER_METRE = 230.0
SHADES_OUTSIDE = (0.90, 0.78, 0.84, 0.96, 0.50, 1.05)
SHADES_INSIDE = (0.95, 0.88, 0.92, 1.00, 0.90, 1.00)
"""Light that the faces -x +x -y +y -z +z of a box, and of the room, receive."""
PLAIN = 0.10
"""Contrast of a plain wall, a share of the plaster's."""


class Builder:
    """Collects upright boxes and the textures that they wear."""

    def __init__(self, dice: Dice) -> None:
        self._dice = dice
        self._turns: list[tuple[float, float]] = []
        self._centres: list[Size] = []
        self._halves: list[Size] = []
        self._faces: list[np.ndarray] = []
        self._pyramids: list[np.ndarray] = []

    def texture(self, painter: Callable[[Dice], np.ndarray]) -> int:
        """Paint a new texture and return its number."""
        self._pyramids.append(textures.build_pyramid(painter(self._dice)))
        return len(self._pyramids) - 1

    def add(self, texture: int, centre: Size, size: Size, turn: tuple[float, float] = (1.0, 0.0),
            contrast: float = 1.0, tone: float = 0.0, fitted: bool = False) -> None:
        """Add a box with one texture, laid in its own scale or `fitted` to every side once.

        The texel 128 becomes 128 + tone under full light, others differ by `contrast`.
        """
        faces = np.zeros(6, dtype=FACE)
        for side, face in enumerate(faces):
            shade = (SHADES_OUTSIDE if self._centres else SHADES_INSIDE)[side]
            face['texture'] = texture
            face['contrast'] = contrast * shade
            face['bias'] = (128.0 + tone - 128.0 * contrast) * shade
            across, down = ((1, 2), (0, 2), (0, 1))[side // 2]
            for axis, scale, offset in ((across, 'scale_u', 'offset_u'),
                                        (down, 'scale_v', 'offset_v')):
                face[scale] = TEXTURE_SIZE / size[axis] if fitted else TEXELS_PER_METRE
                face[offset] = 0.5 * TEXTURE_SIZE if fitted else self._dice.integer(
                    0, TEXTURE_SIZE)
        self._turns.append(turn)
        self._centres.append(centre)
        self._halves.append((0.5 * size[0], 0.5 * size[1], 0.5 * size[2]))
        self._faces.append(faces)

    def paint(self, box: int, side: int, texture: int, contrast: float, tone: float) -> None:
        """Give one side of a box another texture."""
        shade = (SHADES_OUTSIDE if box else SHADES_INSIDE)[side]
        face = self._faces[box][side]
        face['texture'] = texture
        face['contrast'] = contrast * shade
        face['bias'] = (128.0 + tone - 128.0 * contrast) * shade

    def build(self, lamp: Size) -> Scene:
        """Return what was collected."""
        return Scene(np.array(self._turns), np.array(self._centres), np.array(self._halves),
                     np.stack(self._faces), np.stack(self._pyramids), np.array(lamp))


def build_scene(dice: Dice, style: str, size: Size, path: np.ndarray) -> Scene:
    """Return a furnished room of `size` [m], its floor around the origin, for a path (N, 3)."""
    builder = Builder(dice)
    room = _Room(builder, dice, size, path)
    room.surface(plain_walls=2 if style == 'mixed' else 0)
    room.furnish_walls()
    room.furnish_floor()
    return builder.build((dice.between(-1.0, 1.0), dice.between(-1.0, 1.0), size[2] - 0.3))


class _Room:
    """Places things; walls are numbered like the sides of a box: -x +x -y +y."""

    def __init__(self, builder: Builder, dice: Dice, size: Size, path: np.ndarray) -> None:
        self._builder, self._dice, self._size, self._path = builder, dice, size, path
        self._prints = [builder.texture(textures.poster) for _ in range(4)]
        self._books, self._door, self._window, self._cupboard, self._parcel, self._wood = (
            builder.texture(painter) for painter in (
                textures.books, textures.door, textures.window, textures.cupboard,
                textures.cardboard, textures.planks))
        self._plain: list[int] = []

    def surface(self, plain_walls: int) -> None:
        """Lay the floor, the ceiling and the walls."""
        dice, builder = self._dice, self._builder
        plaster = builder.texture(textures.plaster)
        rough = builder.texture(dice.shuffled([textures.brick, textures.concrete,
                                               textures.wallpaper])[0])
        floor = builder.texture(dice.shuffled([textures.planks, textures.tiles,
                                               textures.carpet])[0])
        builder.add(plaster, (0.0, 0.0, 0.5 * self._size[2]), self._size)
        walls = dice.shuffled([0, 1, 2, 3])
        self._plain = walls[:plain_walls]
        for place, wall in enumerate(walls):
            if wall in self._plain:
                builder.paint(0, wall, plaster, PLAIN, dice.between(10.0, 60.0))
            elif place == 3:
                builder.paint(0, wall, plaster, 0.6, dice.between(0.0, 50.0))
            else:
                builder.paint(0, wall, rough, dice.between(0.6, 1.0), dice.between(-10.0, 30.0))
        builder.paint(0, 4, floor, 0.9, 0.0)
        builder.paint(0, 5, plaster, 0.25, 70.0)
        for row in (-0.25, 0.25):
            for column in (-0.25, 0.25):
                builder.add(plaster, (row * self._size[0], column * self._size[1],
                                      self._size[2]), (0.6, 0.6, 0.1), contrast=0.1, tone=120.0)

    def furnish_walls(self) -> None:
        """Go along every wall and put something everywhere but on the plain ones."""
        dice = self._dice
        for wall in range(4):
            length = self._size[1] if wall < 2 else self._size[0]
            self._mount(wall, self._wood, 0.0, length - 0.02, 0.0, 0.08, 0.02, tone=-50.0)
            if wall in self._plain:
                continue
            along = -0.5 * length + dice.between(0.2, 0.6)
            while along < 0.5 * length - 1.3:
                along += self._put_against(wall, along) + dice.between(0.1, 0.5)

    def _put_against(self, wall: int, along: float) -> float:
        """Put one thing, or one above the other, against a wall; return how wide it is [m]."""
        dice = self._dice
        kind = dice.integer(0, 8)
        wide = dice.between(0.7, 1.2)
        middle = along + 0.5 * wide
        if kind == 0:
            self._mount(wall, self._window, middle, wide, 0.9, 2.1, 0.06, fitted=True)
        elif kind == 1:
            self._mount(wall, self._door, middle, wide, 0.0, 2.05, 0.05, fitted=True)
        elif kind == 2:
            self._mount(wall, self._books, middle, wide, 0.0, dice.between(1.5, 2.2), 0.3,
                        fitted=True)
        elif kind == 3:
            self._mount(wall, self._cupboard, middle, wide, 0.0, dice.between(0.8, 1.9), 0.45,
                        fitted=True)
        elif kind == 4:
            wide = dice.between(0.15, 0.3)
            self._mount(wall, self._wood, along + 0.5 * wide, wide, 0.0, self._size[2], wide)
        else:
            bottom = dice.between(0.9, 1.5)
            self._mount(wall, self._print(), middle, wide, bottom,
                        bottom + dice.between(0.6, 1.0), 0.03, fitted=True)
            if bottom > 1.2:
                self._mount(wall, self._cupboard, middle, wide, 0.0, dice.between(0.5, 0.9),
                            0.4, fitted=True)
        return wide

    def _mount(self, wall: int, texture: int, along: float, wide: float, bottom: float,
               top: float, deep: float, **look: float) -> None:
        """Add a box that touches a wall."""
        distance = (-0.5 if wall % 2 == 0 else 0.5) * (self._size[wall // 2] - deep)
        height = 0.5 * (bottom + top)
        if wall < 2:
            self._builder.add(texture, (distance, along, height), (deep, wide, top - bottom),
                              **look)
        else:
            self._builder.add(texture, (along, distance, height), (wide, deep, top - bottom),
                              **look)

    def furnish_floor(self) -> None:
        """Try places for tables, parcels, pillars and screens until enough have found one."""
        dice = self._dice
        for _ in range(24):
            x = dice.between(-0.5, 0.5) * (self._size[0] - 1.0)
            y = dice.between(-0.5, 0.5) * (self._size[1] - 1.0)
            # Rational points of the circle: a heading without sine and cosine.
            t = dice.between(-1.0, 1.0)
            turn = ((1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t))
            kind = dice.integer(0, 4)
            if kind == 0:
                self._put_table(x, y, turn)
            elif kind == 1:
                self._put_parcels(x, y, turn)
            elif kind == 2:
                side = dice.between(0.2, 0.4)
                self._stand(self._wood, (x, y), (side, side, self._size[2]), 0.0, turn)
            else:
                self._stand(self._print(), (x, y), (dice.between(0.6, 1.1), 0.05, 1.7), 0.0,
                            turn, fitted=True)

    def _put_table(self, x: float, y: float, turn: tuple[float, float]) -> None:
        wide, deep, dice = self._dice.between(1.0, 1.6), self._dice.between(0.6, 0.9), self._dice
        if not self._stand(self._wood, (x, y), (wide, deep, 0.04), 0.72, turn, tone=30.0):
            return
        for side_x in (-0.45, 0.45):
            for side_y in (-0.45, 0.45):
                self._stand(self._wood, _turned(x, y, turn, side_x * wide, side_y * deep),
                            (0.06, 0.06, 0.72), 0.0, turn, tone=-30.0)
        for spot in (-0.3, 0.0, 0.3):
            place = _turned(x, y, turn, spot * wide, dice.between(-0.2, 0.2) * deep)
            self._stand(dice.shuffled([self._parcel, self._books, self._print()])[0], place,
                        (dice.between(0.15, 0.3), dice.between(0.1, 0.3), dice.between(0.1, 0.4)),
                        0.76, turn, fitted=True)

    def _put_parcels(self, x: float, y: float, turn: tuple[float, float]) -> None:
        side, bottom = self._dice.between(0.4, 0.7), 0.0
        while side > 0.25 and self._stand(self._parcel, (x, y), (side, side, 0.8 * side), bottom,
                                          turn, fitted=True):
            bottom += 0.8 * side
            side *= self._dice.between(0.5, 0.9)
            turn = (turn[1], -turn[0]) if self._dice.chance(0.5) else turn

    def _stand(self, texture: int, place: tuple[float, float], size: Size, bottom: float,
               turn: tuple[float, float], **look: float) -> bool:
        """Add a box unless the camera would come too close; return whether it was added."""
        centre = (place[0], place[1], bottom + 0.5 * size[2])
        if distance_to_box(self._path, centre, size, turn).min() < CLEARANCE:
            return False
        self._builder.add(texture, centre, size, turn, **look)
        return True

    def _print(self) -> int:
        return self._prints[self._dice.integer(0, len(self._prints))]


def _turned(x: float, y: float, turn: tuple[float, float], ahead: float, left: float
            ) -> tuple[float, float]:
    """Return the place that is `ahead` and `left` of (x, y) for someone who faces `turn`."""
    return x + turn[0] * ahead - turn[1] * left, y + turn[1] * ahead + turn[0] * left


def distance_to_box(points: np.ndarray, centre: Size, size: Size, turn: tuple[float, float]
                    ) -> np.ndarray:
    """Return the distances (N,) of points (N, 3) to an upright box, 0 inside."""
    x, y, z = (points - np.array(centre)).T
    local = (turn[0] * x + turn[1] * y, turn[0] * y - turn[1] * x, z)
    excess = [np.maximum(np.abs(value) - 0.5 * extent, 0.0)
              for value, extent in zip(local, size, strict=True)]
    return np.sqrt(excess[0] ** 2 + excess[1] ** 2 + excess[2] ** 2)
