# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rendered room: what hangs on its walls and stands around in it, never in the way."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from kfvo_ros.sequences.synthetic import textures as textures
from kfvo_ros.sequences.synthetic.boxes import BoxCollector, Size, Turn, distance_to_box
from kfvo_ros.sequences.synthetic.renderer import Scene
from kfvo_ros.sequences.synthetic.rng import StableRng

CLEARANCE = 0.45
"""Furniture keeps this far from the camera's path [m]."""
PLAIN_WALLS = {'smooth': 0, 'fast': 0, 'mixed': 2, 'hectic': 3}
"""How many of the four walls show next to nothing."""
ATTEMPTS = {'smooth': 12, 'fast': 12, 'mixed': 10, 'hectic': 10}
"""How often a place for furniture is looked for; what would be in the way is left out."""


class Furniture(NamedTuple):
    """What is put against a wall: its texture, and ranges of its size [m]."""

    texture: str
    wide: tuple[float, float]
    bottom: tuple[float, float]
    high: tuple[float, float]
    deep: float


PRINT = Furniture('print', (0.7, 1.2), (0.9, 1.5), (0.6, 1.0), 0.03)
SIDEBOARD = Furniture('cupboard', (0.7, 1.2), (0.0, 0.0), (0.5, 0.85), 0.4)
WALL_THINGS = (
    PRINT, PRINT, SIDEBOARD,
    Furniture('window', (0.8, 1.3), (0.9, 0.9), (1.1, 1.3), 0.06),
    Furniture('door', (0.8, 1.0), (0.0, 0.0), (2.0, 2.1), 0.05),
    Furniture('books', (0.7, 1.2), (0.0, 0.0), (1.5, 2.2), 0.3),
    Furniture('cupboard', (0.7, 1.2), (0.0, 0.0), (1.2, 1.9), 0.45))


def build_scene(rng: StableRng, temper: str, size: Size, path: np.ndarray) -> Scene:
    """Return a room of `size` [m], its floor around the origin, furnished beside a path (N, 3)."""
    room = _Room(rng, size, path)
    room.surface(PLAIN_WALLS[temper])
    room.furnish_walls()
    room.furnish_floor(ATTEMPTS[temper])
    lamp = rng.between(-1.0, 1.0), rng.between(-1.0, 1.0), size[2] - 0.6
    return room.boxes.build(lamp)


class _Room:
    """Places things; walls are numbered like the sides of a box: -x +x -y +y."""

    def __init__(self, rng: StableRng, size: Size, path: np.ndarray) -> None:
        self.boxes = BoxCollector(rng)
        self._rng, self._size, self._path = rng, size, path
        self._plain: list[int] = []
        painters = {'print': [textures.poster] * 4, 'books': [textures.books],
                    'door': [textures.door], 'window': [textures.window],
                    'cupboard': [textures.cupboard], 'parcel': [textures.cardboard],
                    'wood': [textures.planks]}
        self._textures = {name: [self.boxes.texture(painter) for painter in group]
                          for name, group in painters.items()}

    def surface(self, plain_walls: int) -> None:
        """Paint the walls, `plain_walls` of them plain, the floor and a ceiling with lamps."""
        rng, boxes = self._rng, self.boxes
        plaster, panels = boxes.texture(textures.plaster), boxes.texture(textures.panels)
        rough = boxes.texture(rng.choice([textures.brick, textures.concrete,
                                          textures.wallpaper]))
        floor = boxes.texture(rng.choice([textures.planks, textures.tiles, textures.carpet]))
        boxes.add(plaster, (0.0, 0.0, 0.5 * self._size[2]), self._size)
        plain = [(panels, 0.5, 40.0), (plaster, 0.22, 45.0), (panels, 0.5, 30.0),
                 (plaster, 0.22, 20.0)]
        lively = [(rough, 0.6, 10.0), (plaster, 0.25, 40.0), (panels, 0.6, 20.0),
                  (plaster, 0.25, 25.0)]
        walls = rng.shuffled(range(4))
        self._plain = walls[:plain_walls]
        for wall, look in zip(walls, plain[:plain_walls] + lively, strict=False):
            boxes.paint(0, wall, *look)
        boxes.paint(0, 4, floor, 0.75, 0.0)
        boxes.paint(0, 5, plaster, 0.1, 40.0)
        for row in (-0.25, 0.25):
            for column in (-0.25, 0.25):
                boxes.add(plaster, (row * self._size[0], column * self._size[1], self._size[2]),
                          (0.6, 0.6, 0.1), contrast=0.1, tone=350.0)

    def furnish_walls(self) -> None:
        """Go along every wall and put something everywhere but on the plain ones."""
        rng = self._rng
        for wall in range(4):
            length = self._size[1] if wall < 2 else self._size[0]
            self._mount('wood', wall, 0.0, (length - 0.02, 0.08, 0.02), 0.0, tone=-50.0)
            along = -0.5 * length + rng.between(0.2, 0.8)
            while along < 0.5 * length - 1.3 and wall not in self._plain:
                thing = rng.choice(WALL_THINGS)
                wide, bottom = rng.between(*thing.wide), rng.between(*thing.bottom)
                middle = along + 0.5 * wide
                self._mount(thing.texture, wall, middle,
                            (wide, rng.between(*thing.high), thing.deep), bottom, fitted=True)
                if bottom > 1.2:
                    self._mount(SIDEBOARD.texture, wall, middle,
                                (wide, rng.between(*SIDEBOARD.high), SIDEBOARD.deep), 0.0,
                                fitted=True)
                along += wide + rng.between(0.2, 1.0)

    def _mount(self, texture: str, wall: int, along: float, size: Size, bottom: float,
               **look: Any) -> None:
        """Put a box of `size` (wide, high, deep) against a wall."""
        wide, high, deep = size
        out = (0.5 if wall % 2 else -0.5) * (self._size[wall // 2] - deep)
        height = bottom + 0.5 * high
        if wall < 2:
            self.boxes.add(self._pick(texture), (out, along, height), (deep, wide, high), **look)
        else:
            self.boxes.add(self._pick(texture), (along, out, height), (wide, deep, high), **look)

    def furnish_floor(self, attempts: int) -> None:
        """Look for places for tables, parcels, pillars and screens."""
        rng = self._rng
        for _ in range(attempts):
            spot = (rng.between(-0.5, 0.5) * (self._size[0] - 1.0),
                    rng.between(-0.5, 0.5) * (self._size[1] - 1.0))
            # Rational points of the circle: a heading without sine and cosine.
            t = rng.between(-1.0, 1.0)
            turn = (1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t)
            kind = rng.integer(0, 4)
            if kind == 0:
                self._put_table(spot, turn)
            elif kind == 1:
                self._put_parcels(spot, turn)
            elif kind == 2:
                side = rng.between(0.2, 0.4)
                self._stand('wood', spot, (side, side, self._size[2]), 0.0, turn)
            else:
                self._stand('print', spot, (rng.between(0.6, 1.1), 0.05, 1.7), 0.0, turn,
                            fitted=True)

    def _put_table(self, spot: tuple[float, float], turn: Turn) -> None:
        """Stand a table with three things on it."""
        rng = self._rng
        wide, deep = rng.between(1.0, 1.6), rng.between(0.6, 0.9)
        if not self._stand('wood', spot, (wide, deep, 0.04), 0.72, turn, tone=30.0):
            return
        for side_x in (-0.45, 0.45):
            for side_y in (-0.45, 0.45):
                self._stand('wood', _offset_spot(spot, turn, side_x * wide, side_y * deep),
                            (0.06, 0.06, 0.72), 0.0, turn, tone=-30.0)
        for side in (-0.3, 0.0, 0.3):
            place = _offset_spot(spot, turn, side * wide, rng.between(-0.2, 0.2) * deep)
            self._stand(rng.choice(['parcel', 'books', 'print']), place,
                        (rng.between(0.15, 0.3), rng.between(0.1, 0.3),
                         rng.between(0.1, 0.4)), 0.76, turn, fitted=True)

    def _put_parcels(self, spot: tuple[float, float], turn: Turn) -> None:
        """Stack parcels as high as the path allows."""
        side, bottom = self._rng.between(0.4, 0.7), 0.0
        while side > 0.25 and self._stand('parcel', spot, (side, side, 0.8 * side), bottom, turn,
                                          fitted=True):
            bottom += 0.8 * side
            side *= self._rng.between(0.5, 0.9)

    def _stand(self, texture: str, spot: tuple[float, float], size: Size, bottom: float,
               turn: Turn, **look: Any) -> bool:
        """Add a box unless the camera would come too close; return whether it was added."""
        centre = (*spot, bottom + 0.5 * size[2])
        if distance_to_box(self._path, centre, size, turn).min() < CLEARANCE:
            return False
        self.boxes.add(self._pick(texture), centre, size, turn, **look)
        return True

    def _pick(self, texture: str) -> int:
        """Return the number of a texture of that name."""
        return self._rng.choice(self._textures[texture])


def _offset_spot(spot: tuple[float, float], turn: Turn, ahead: float, left: float
           ) -> tuple[float, float]:
    """Return the place `ahead` and `left` of a spot for someone who faces `turn`."""
    return (spot[0] + turn[0] * ahead - turn[1] * left,
            spot[1] + turn[1] * ahead + turn[0] * left)
