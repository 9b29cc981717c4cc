# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rendered room: the camera's loop, the walls, and furniture that keeps clear of the loop."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from kfvo_ros.sequences.synthetic import textures
from kfvo_ros.sequences.synthetic.motion import ClosedSpline
from kfvo_ros.sequences.synthetic.rng import StableRng, quantise
from kfvo_ros.sequences.synthetic.scene import Heading, Scene, SceneBuilder, Vec3, distance_to_box

CONTROL_POINTS = 9
WALL_CLEARANCE = 1.0
"""Distance of the loop from the walls [m]."""
CAMERA_HEIGHTS = (1.15, 1.75)
FURNITURE_CLEARANCE = 0.45
"""Distance of furniture from the loop [m]."""
PLAIN_WALLS = {'smooth': 0, 'fast': 0, 'mixed': 2, 'hectic': 3}
"""Number of walls, of four, with very low contrast, by style."""
FLOOR_ATTEMPTS = {'smooth': 12, 'fast': 12, 'mixed': 10, 'hectic': 10}
"""Number of random positions for furniture by style; positions too near the loop stay empty."""
Position2 = tuple[float, float]


class Furniture(NamedTuple):
    """An object at a wall: its texture, and ranges of its size and height [m]."""

    texture: str
    width: tuple[float, float]
    bottom: tuple[float, float]
    height: tuple[float, float]
    depth: float


PRINT = Furniture('print', (0.7, 1.2), (0.9, 1.5), (0.6, 1.0), 0.03)
SIDEBOARD = Furniture('cupboard', (0.7, 1.2), (0.0, 0.0), (0.5, 0.85), 0.4)
WALL_FURNITURE = (
    PRINT, PRINT, SIDEBOARD,
    Furniture('window', (0.8, 1.3), (0.9, 0.9), (1.1, 1.3), 0.06),
    Furniture('door', (0.8, 1.0), (0.0, 0.0), (2.0, 2.1), 0.05),
    Furniture('books', (0.7, 1.2), (0.0, 0.0), (1.5, 2.2), 0.3),
    Furniture('cupboard', (0.7, 1.2), (0.0, 0.0), (1.2, 1.9), 0.45))


def room_loop(rng: StableRng, size: Vec3) -> ClosedSpline:
    """Return a loop in a room of `size` [m]; the origin is the middle of its floor."""
    reach_x, reach_y = 0.5 * size[0] - WALL_CLEARANCE, 0.5 * size[1] - WALL_CLEARANCE
    step = (1.0 if rng.chance(0.5) else -1.0) * 2.0 * math.pi / CONTROL_POINTS
    start = rng.between(0.0, CONTROL_POINTS)
    points = []
    for index in range(CONTROL_POINTS):
        angle = step * (start + index + rng.between(-0.15, 0.15))
        radius = rng.between(0.7, 1.0)
        points.append((quantise(reach_x * radius * math.cos(angle)),
                       quantise(reach_y * radius * math.sin(angle)),
                       rng.between(*CAMERA_HEIGHTS)))
    return ClosedSpline(points)


def build_room(rng: StableRng, style: str, size: Vec3, path: np.ndarray) -> Scene:
    """Return a room of `size` [m], furnished clear of a path (N, 3).

    The origin is the middle of its floor.
    """
    room = _RoomBuilder(rng, size, path)
    room.add_shell(PLAIN_WALLS[style])
    room.furnish_walls()
    room.furnish_floor(FLOOR_ATTEMPTS[style])
    light = rng.between(-1.0, 1.0), rng.between(-1.0, 1.0), size[2] - 0.6
    return room.scene.build(light)


class _RoomBuilder:
    """Adds a room's boxes to a scene; walls are numbered like the sides of a box: -x +x -y +y."""

    def __init__(self, rng: StableRng, size: Vec3, path: np.ndarray) -> None:
        self.scene = SceneBuilder(rng)
        self._rng, self._size, self._path = rng, size, path
        self._plain_walls: list[int] = []
        generators = {'print': [textures.poster] * 4, 'books': [textures.books],
                      'door': [textures.door], 'window': [textures.window],
                      'cupboard': [textures.cupboard], 'parcel': [textures.cardboard],
                      'wood': [textures.planks]}
        self._textures = {name: [self.scene.add_texture(generate) for generate in group]
                          for name, group in generators.items()}

    def add_shell(self, plain_walls: int) -> None:
        """Add walls, `plain_walls` of them of low contrast, a floor and a ceiling with lamps."""
        rng, scene = self._rng, self.scene
        plaster, panels = (scene.add_texture(textures.plaster),
                           scene.add_texture(textures.panels))
        rough = scene.add_texture(rng.choice([textures.brick, textures.concrete,
                                              textures.wallpaper]))
        floor = scene.add_texture(rng.choice([textures.planks, textures.tiles,
                                              textures.carpet]))
        scene.add_box(plaster, (0.0, 0.0, 0.5 * self._size[2]), self._size)
        plain = [(panels, 0.5, 40.0), (plaster, 0.22, 45.0), (panels, 0.5, 30.0),
                 (plaster, 0.22, 20.0)]
        textured = [(rough, 0.6, 10.0), (plaster, 0.25, 40.0), (panels, 0.6, 20.0),
                    (plaster, 0.25, 25.0)]
        walls = rng.shuffled(range(4))
        self._plain_walls = walls[:plain_walls]
        for wall, material in zip(walls, plain[:plain_walls] + textured, strict=False):
            scene.set_material(0, wall, *material)
        scene.set_material(0, 4, floor, 0.75, 0.0)
        scene.set_material(0, 5, plaster, 0.1, 40.0)
        for row in (-0.25, 0.25):
            for column in (-0.25, 0.25):
                scene.add_box(plaster, (row * self._size[0], column * self._size[1],
                                        self._size[2]),
                              (0.6, 0.6, 0.1), contrast=0.1, brightness=350.0)

    def furnish_walls(self) -> None:
        """Add a skirting board to every wall, and furniture to those that are not plain."""
        rng = self._rng
        for wall in range(4):
            length = self._size[1] if wall < 2 else self._size[0]
            self._add_at_wall('wood', wall, 0.0, (length - 0.02, 0.08, 0.02), 0.0,
                              brightness=-50.0)
            along = -0.5 * length + rng.between(0.2, 0.8)
            while along < 0.5 * length - 1.3 and wall not in self._plain_walls:
                furniture = rng.choice(WALL_FURNITURE)
                width, bottom = rng.between(*furniture.width), rng.between(*furniture.bottom)
                middle = along + 0.5 * width
                self._add_at_wall(furniture.texture, wall, middle,
                                  (width, rng.between(*furniture.height), furniture.depth),
                                  bottom, stretch=True)
                if bottom > 1.2:
                    self._add_at_wall(SIDEBOARD.texture, wall, middle,
                                      (width, rng.between(*SIDEBOARD.height), SIDEBOARD.depth),
                                      0.0, stretch=True)
                along += width + rng.between(0.2, 1.0)

    def furnish_floor(self, attempts: int) -> None:
        """Add tables, parcels, pillars and screens at random positions."""
        rng = self._rng
        for _ in range(attempts):
            position = (rng.between(-0.5, 0.5) * (self._size[0] - 1.0),
                        rng.between(-0.5, 0.5) * (self._size[1] - 1.0))
            # Rational parametrisation of the circle: a heading without sine and cosine.
            t = rng.between(-1.0, 1.0)
            heading = (1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t)
            kind = rng.integer(0, 4)
            if kind == 0:
                self._add_table(position, heading)
            elif kind == 1:
                self._add_parcels(position, heading)
            elif kind == 2:
                side = rng.between(0.2, 0.4)
                self._add_if_clear('wood', position, (side, side, self._size[2]), 0.0, heading)
            else:
                self._add_if_clear('print', position, (rng.between(0.6, 1.1), 0.05, 1.7), 0.0,
                                   heading, stretch=True)

    def _add_at_wall(self, texture: str, wall: int, along: float, size: Vec3, bottom: float,
                     **material: Any) -> None:
        """Add a box of `size` (width, height, depth) at a wall."""
        width, height, depth = size
        out = (0.5 if wall % 2 else -0.5) * (self._size[wall // 2] - depth)
        middle = bottom + 0.5 * height
        index = self._random_texture(texture)
        if wall < 2:
            self.scene.add_box(index, (out, along, middle), (depth, width, height), **material)
        else:
            self.scene.add_box(index, (along, out, middle), (width, depth, height), **material)

    def _add_table(self, position: Position2, heading: Heading) -> None:
        """Add a table with three objects on it."""
        rng = self._rng
        width, depth = rng.between(1.0, 1.6), rng.between(0.6, 0.9)
        if not self._add_if_clear('wood', position, (width, depth, 0.04), 0.72, heading,
                                  brightness=30.0):
            return
        for side_x in (-0.45, 0.45):
            for side_y in (-0.45, 0.45):
                corner = _offset_position(position, heading, side_x * width, side_y * depth)
                self._add_if_clear('wood', corner, (0.06, 0.06, 0.72), 0.0, heading,
                                   brightness=-30.0)
        for side in (-0.3, 0.0, 0.3):
            top = _offset_position(position, heading, side * width,
                                   rng.between(-0.2, 0.2) * depth)
            self._add_if_clear(rng.choice(['parcel', 'books', 'print']), top,
                               (rng.between(0.15, 0.3), rng.between(0.1, 0.3),
                                rng.between(0.1, 0.4)), 0.76, heading, stretch=True)

    def _add_parcels(self, position: Position2, heading: Heading) -> None:
        """Add a stack of parcels, as high as the path allows."""
        side, bottom = self._rng.between(0.4, 0.7), 0.0
        while side > 0.25 and self._add_if_clear('parcel', position, (side, side, 0.8 * side),
                                                 bottom, heading, stretch=True):
            bottom += 0.8 * side
            side *= self._rng.between(0.5, 0.9)

    def _add_if_clear(self, texture: str, position: Position2, size: Vec3, bottom: float,
                      heading: Heading, **material: Any) -> bool:
        """Add a box unless it is too near the path; return whether it was added."""
        centre = (*position, bottom + 0.5 * size[2])
        if distance_to_box(self._path, centre, size, heading).min() < FURNITURE_CLEARANCE:
            return False
        self.scene.add_box(self._random_texture(texture), centre, size, heading, **material)
        return True

    def _random_texture(self, name: str) -> int:
        """Return the index of a random texture of that name."""
        return self._rng.choice(self._textures[name])


def _offset_position(position: Position2, heading: Heading, forward: float, left: float
                     ) -> Position2:
    """Return a position moved `forward` and to the `left` in the frame of `heading`."""
    return (position[0] + heading[0] * forward - heading[1] * left,
            position[1] + heading[1] * forward + heading[0] * left)
