# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rendered street: a road around a block, with houses, fences, trees and parked cars."""

from __future__ import annotations

import math

import numpy as np

from kfvo_ros.sequences.synthetic import textures
from kfvo_ros.sequences.synthetic.motion import ClosedSpline
from kfvo_ros.sequences.synthetic.rng import StableRng, quantise
from kfvo_ros.sequences.synthetic.scene import Heading, Scene, SceneBuilder, Vec3, distance_to_box
from kfvo_ros.sequences.synthetic.shading import AMBIENT

CONTROL_POINT_SPACING, LATERAL_OFFSET, CAMERA_HEIGHT = 12.0, 1.2, 1.65
"""Approximate spacing of the road's control points, limit of their offset from a straight line,
and height of the camera above the road [m]."""
WORLD_SIZE = (500.0, 500.0, 80.0)
"""The ceiling is the sky, and the walls are distant hills [m]."""
TEXELS_PER_METRE = 40.0
DAYLIGHT, FAR_LIGHT = 1.0 / AMBIENT, (0.0, 0.0, -1e4)
"""Ambient light only: the lamp is out of reach."""
LANE_CLEARANCE, ROAD_CLEARANCE = 2.4, 4.3
"""Distances from the camera's path, of parked cars and tree crowns, and of all else [m]."""


def street_loop(rng: StableRng) -> ClosedSpline:
    """Return a road around an L-shaped block; the origin is in the middle of it.

    Five corners turn one way and one turns the other way, all rounded by the spline; between
    them the road winds a little.
    """
    width, depth = rng.between(90.0, 140.0), rng.between(90.0, 140.0)
    inner_x, inner_y = width * rng.between(0.35, 0.65), depth * rng.between(0.35, 0.65)
    corners = [(0.0, 0.0), (width, 0.0), (width, inner_y), (inner_x, inner_y), (inner_x, depth),
               (0.0, depth)]
    if rng.chance(0.5):
        corners.reverse()
    points = []
    for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
        along = end[0] - start[0], end[1] - start[1]
        length = abs(along[0]) + abs(along[1])
        pieces = round(length / CONTROL_POINT_SPACING)
        for piece in range(1, pieces):
            share = piece / pieces
            off = rng.between(-LATERAL_OFFSET, LATERAL_OFFSET) / length
            points.append((quantise(start[0] + share * along[0] - off * along[1] - 0.5 * width),
                           quantise(start[1] + share * along[1] + off * along[0] - 0.5 * depth),
                           CAMERA_HEIGHT))
    return ClosedSpline(points)


def build_street(rng: StableRng, path: ClosedSpline) -> Scene:
    """Return a street along a road."""
    street = _StreetBuilder(rng, path)
    street.add_ground()
    for side in (-1.0, 1.0):
        street.add_houses(side)
        street.add_roadside(side)
    return street.scene.build(FAR_LIGHT)


class _StreetBuilder:
    """Adds boxes to a scene, at a distance along the road and to its left [m]."""

    def __init__(self, rng: StableRng, path: ClosedSpline) -> None:
        self.scene = SceneBuilder(rng, TEXELS_PER_METRE)
        self._rng, self._path = rng, path
        self._road = path.sample(60 * len(path)) * (1.0, 1.0, 0.0)
        steps = self._road[1:] - self._road[:-1]
        # An exact sum: the last digit of any other depends on its order.
        self._length = math.fsum(np.sqrt(steps[:, 0] * steps[:, 0] + steps[:, 1] * steps[:, 1]))
        self._textures = {name: [self.scene.add_texture(generate) for _ in range(count)]
                          for name, generate, count in (
                              ('facade', textures.facade, 6), ('leaves', textures.leaves, 2),
                              ('car', textures.cupboard, 3), ('glass', textures.window, 2),
                              ('stone', textures.concrete, 2), ('paving', textures.tiles, 1),
                              ('brick', textures.brick, 2), ('sign', textures.poster, 3),
                              ('plain', textures.plaster, 1))}

    def add_ground(self) -> None:
        """Add the road surface, the sky and the hills."""
        scene, rng = self.scene, self._rng
        scene.add_box(self._random_texture('plain'), (0.0, 0.0, 0.5 * WORLD_SIZE[2]), WORLD_SIZE)
        for wall in range(4):
            scene.set_material(0, wall, self._random_texture('leaves'), 0.2 * DAYLIGHT, 60.0)
        scene.set_material(0, 4, self._random_texture('stone'),
                           rng.between(0.35, 0.7) * DAYLIGHT, rng.between(20.0, 60.0))
        scene.set_material(0, 5, self._random_texture('plain'), 0.0, 160.0)

    def add_houses(self, side: float) -> None:
        """Add houses and fences along one side, with random gaps."""
        rng, along = self._rng, 0.0
        while along < self._length:
            width, setback = rng.between(7.0, 14.0), rng.between(8.0, 13.0)
            if rng.chance(0.75):
                depth = rng.between(6.0, 9.0)
                self._add_if_clear('facade', along, side * (setback + 0.5 * depth),
                                   (width, depth, rng.between(4.0, 10.0)), stretch=True)
            if rng.chance(0.5):
                self._add_if_clear(rng.choice(['leaves', 'brick', 'stone']), along, side * 6.5,
                                   (width, 0.5, rng.between(0.6, 1.6)))
            along += width + rng.between(0.5, 5.0)

    def add_roadside(self, side: float) -> None:
        """Add a pavement along one side, with cars, trees, posts and signs."""
        rng, along = self._rng, 0.0
        while along < self._length:
            self._add_if_clear('paving', along, side * 5.6, (7.5, 1.8, 0.24), -0.12)
            kind = rng.integer(0, 6)
            if kind < 2:
                self._add_car(along, side * rng.between(3.5, 3.9))
            elif kind == 2:
                self._add_tree(along, side * rng.between(5.2, 6.2))
            elif kind == 3:
                self._add_if_clear('stone', along, side * 5.0,
                                   (0.16, 0.16, rng.between(4.0, 6.0)))
            elif kind == 4:
                self._add_if_clear('sign', along, side * 5.6, (0.3, 1.0, 1.4),
                                   rng.between(0.3, 1.5), stretch=True)
            along += rng.between(5.0, 8.0)

    def _add_car(self, along: float, left: float) -> None:
        """Add a parked car: a body and a cabin."""
        rng = self._rng
        length, brightness = rng.between(3.8, 4.8), rng.between(-60.0, 60.0)
        if self._add_if_clear('car', along, left, (length, 1.75, 0.65), 0.25,
                              brightness=brightness, stretch=True, clearance=LANE_CLEARANCE):
            self._add_if_clear('glass', along, left, (0.55 * length, 1.5, 0.55), 0.9,
                               stretch=True, brightness=-40.0, clearance=LANE_CLEARANCE)

    def _add_tree(self, along: float, left: float) -> None:
        """Add a tree: a trunk and a crown."""
        rng = self._rng
        side, trunk = rng.between(1.5, 3.0), rng.between(1.8, 3.0)
        if self._add_if_clear('stone', along, left, (0.25, 0.25, trunk), brightness=-50.0):
            self._add_if_clear('leaves', along, left, (side, side, rng.between(1.5, 3.0)), trunk,
                               clearance=LANE_CLEARANCE)

    def _add_if_clear(self, texture: str, along: float, left: float, size: Vec3,
                      bottom: float = 0.0, clearance: float = ROAD_CLEARANCE,
                      brightness: float = 0.0, stretch: bool = False) -> bool:
        """Add a box (along the road, across, up) unless it is too near the path.

        Return whether it was added.
        """
        position, derivative = self._path.evaluate(len(self._path) * along / self._length)
        norm = math.sqrt(derivative[0] * derivative[0] + derivative[1] * derivative[1])
        heading: Heading = derivative[0] / norm, derivative[1] / norm
        centre = (position[0] - heading[1] * left, position[1] + heading[0] * left,
                  bottom + 0.5 * size[2])
        if distance_to_box(self._road, (centre[0], centre[1], 0.0),
                           (size[0], size[1], 1.0), heading).min() < clearance:
            return False
        self.scene.add_box(self._random_texture(texture), centre, size, heading, DAYLIGHT,
                           128.0 * (DAYLIGHT - 1.0) + DAYLIGHT * brightness, stretch)
        return True

    def _random_texture(self, name: str) -> int:
        """Return the index of a random texture of that name."""
        return self._rng.choice(self._textures[name])
