# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rendered street: houses, fences, trees and parked cars on both sides of a road."""

from __future__ import annotations

import math

import numpy as np

from kfvo_ros.sequences.synthetic import textures as textures
from kfvo_ros.sequences.synthetic.boxes import BoxCollector, Size, Turn, distance_to_box
from kfvo_ros.sequences.synthetic.path import Path
from kfvo_ros.sequences.synthetic.renderer import Scene
from kfvo_ros.sequences.synthetic.rng import StableRng
from kfvo_ros.sequences.synthetic.shading import AMBIENT

WORLD = (500.0, 500.0, 80.0)
"""The sky is a ceiling, and far hills are walls [m]."""
TEXELS_PER_METRE = 40.0
DAYLIGHT, NO_LAMP = 1.0 / AMBIENT, (0.0, 0.0, -1e4)
LANE, ROAD = 2.4, 4.3
"""Parked cars and crowns of trees keep so far from the camera's path, and all else [m]."""


def build_street(rng: StableRng, path: Path) -> Scene:
    """Return what stands along a road."""
    street = _Street(rng, path)
    street.lay_ground()
    for side in (-1.0, 1.0):
        street.build_houses(side)
        street.line_road(side)
    return street.boxes.build(NO_LAMP)


class _Street:
    """Places things beside the road, at a place on it and so far to its left."""

    def __init__(self, rng: StableRng, path: Path) -> None:
        self.boxes = BoxCollector(rng, TEXELS_PER_METRE)
        self._rng, self._path = rng, path
        self._road = path.positions(60 * len(path)) * (1.0, 1.0, 0.0)
        steps = self._road[1:] - self._road[:-1]
        # Added up exactly: elsewhere the last digit of a sum depends on its order.
        self._length = math.fsum(np.sqrt(steps[:, 0] * steps[:, 0] + steps[:, 1] * steps[:, 1]))
        self._textures = {name: [self.boxes.texture(painter) for _ in range(count)]
                          for name, painter, count in (
                              ('facade', textures.facade, 6), ('leaves', textures.leaves, 2),
                              ('car', textures.cupboard, 3), ('glass', textures.window, 2),
                              ('stone', textures.concrete, 2), ('paving', textures.tiles, 1),
                              ('brick', textures.brick, 2), ('sign', textures.poster, 3),
                              ('plain', textures.plaster, 1))}

    def lay_ground(self) -> None:
        """Put the road under the sky."""
        boxes, rng = self.boxes, self._rng
        boxes.add(self._pick('plain'), (0.0, 0.0, 0.5 * WORLD[2]), WORLD)
        for wall in range(4):
            boxes.paint(0, wall, self._pick('leaves'), 0.2 * DAYLIGHT, 60.0)
        boxes.paint(0, 4, self._pick('stone'), rng.between(0.35, 0.7) * DAYLIGHT,
                    rng.between(20.0, 60.0))
        boxes.paint(0, 5, self._pick('plain'), 0.0, 160.0)

    def build_houses(self, side: float) -> None:
        """Put houses, or a fence where there is none, all along one side."""
        rng, along = self._rng, 0.0
        while along < self._length:
            wide, back = rng.between(7.0, 14.0), rng.between(8.0, 13.0)
            if rng.chance(0.75):
                deep = rng.between(6.0, 9.0)
                self._stand('facade', along, side * (back + 0.5 * deep),
                            (wide, deep, rng.between(4.0, 10.0)), fitted=True)
            if rng.chance(0.5):
                self._stand(rng.choice(['leaves', 'brick', 'stone']), along, side * 6.5,
                            (wide, 0.5, rng.between(0.6, 1.6)))
            along += wide + rng.between(0.5, 5.0)

    def line_road(self, side: float) -> None:
        """Put a pavement along one side, and cars, trees, posts and boxes on it."""
        rng, along = self._rng, 0.0
        while along < self._length:
            self._stand('paving', along, side * 5.6, (7.5, 1.8, 0.24), -0.12)
            kind = rng.integer(0, 6)
            if kind < 2:
                self._park(along, side * rng.between(3.5, 3.9))
            elif kind == 2:
                self._plant(along, side * rng.between(5.2, 6.2))
            elif kind == 3:
                self._stand('stone', along, side * 5.0, (0.16, 0.16, rng.between(4.0, 6.0)))
            elif kind == 4:
                self._stand('sign', along, side * 5.6, (0.3, 1.0, 1.4), rng.between(0.3, 1.5),
                            fitted=True)
            along += rng.between(5.0, 8.0)

    def _park(self, along: float, left: float) -> None:
        """Park a car: a body and a cabin."""
        rng = self._rng
        length, tone = rng.between(3.8, 4.8), rng.between(-60.0, 60.0)
        if self._stand('car', along, left, (length, 1.75, 0.65), 0.25, tone=tone, fitted=True,
                       clearance=LANE):
            self._stand('glass', along, left, (0.55 * length, 1.5, 0.55), 0.9, fitted=True,
                        tone=-40.0, clearance=LANE)

    def _plant(self, along: float, left: float) -> None:
        """Plant a tree: a trunk and a crown."""
        rng = self._rng
        side, trunk = rng.between(1.5, 3.0), rng.between(1.8, 3.0)
        if self._stand('stone', along, left, (0.25, 0.25, trunk), tone=-50.0):
            self._stand('leaves', along, left, (side, side, rng.between(1.5, 3.0)), trunk,
                        clearance=LANE)

    def _stand(self, texture: str, along: float, left: float, size: Size, bottom: float = 0.0,
               clearance: float = ROAD, tone: float = 0.0, fitted: bool = False) -> bool:
        """Add a box (along the road, across, up) unless it is in the way; return whether."""
        position, derivative = self._path.at(len(self._path) * along / self._length)
        norm = math.sqrt(derivative[0] * derivative[0] + derivative[1] * derivative[1])
        turn: Turn = derivative[0] / norm, derivative[1] / norm
        centre = (position[0] - turn[1] * left, position[1] + turn[0] * left,
                  bottom + 0.5 * size[2])
        if distance_to_box(self._road, (centre[0], centre[1], 0.0),
                           (size[0], size[1], 1.0), turn).min() < clearance:
            return False
        self.boxes.add(self._pick(texture), centre, size, turn, DAYLIGHT,
                       128.0 * (DAYLIGHT - 1.0) + DAYLIGHT * tone, fitted)
        return True

    def _pick(self, texture: str) -> int:
        """Return the number of a texture of that name."""
        return self._rng.choice(self._textures[texture])
