# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The closed loop on which the camera of a rendered sequence goes: around a room or a block."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kfvo_ros.sequences.synthetic.rng import StableRng

QUANTUM = 2.0 ** -20
"""Positions [m] and quaternions are whole multiples of this."""
KNOTS = 9
MARGIN = 1.0
"""The path in a room keeps this far from the walls [m]."""
HEIGHTS = (1.15, 1.75)
SPACING, BEND, MOUNTED = 12.0, 1.2, 1.65
"""Knots of a road are about so far apart and up to so far off a straight line, the camera is so
high above it [m]."""


def rounded(value: float) -> float:
    """Return a multiple of QUANTUM: the last digits of a maths library are not for ever."""
    return round(value / QUANTUM) * QUANTUM


class Path:
    """A closed uniform cubic B-spline: two continuous derivatives, inside the hull of its knots.

    ``knots`` (N, 3) in a world with z up [m]; places on it count knots.
    """

    def __init__(self, knots: Sequence[tuple[float, float, float]]) -> None:
        self._knots = knots

    def __len__(self) -> int:
        return len(self._knots)

    def at(self, place: float) -> tuple[list[float], list[float]]:
        """Return position and derivative at a place; the loop closes every len(self)."""
        segment = math.floor(place)
        t = place - segment
        r = 1.0 - t
        weights = (r * r * r / 6.0, (3.0 * t * t * (t - 2.0) + 4.0) / 6.0,
                   (3.0 * r * r * (r - 2.0) + 4.0) / 6.0, t * t * t / 6.0)
        slopes = (-0.5 * r * r, 0.5 * t * (3.0 * t - 4.0), 0.5 * r * (4.0 - 3.0 * r),
                  0.5 * t * t)
        position, derivative = [0.0] * 3, [0.0] * 3
        for offset, (weight, slope) in enumerate(zip(weights, slopes, strict=True)):
            for axis, value in enumerate(self._knots[(segment + offset) % len(self)]):
                position[axis] += weight * value
                derivative[axis] += slope * value
        return position, derivative

    def positions(self, count: int) -> np.ndarray:
        """Return positions (count, 3) all along the loop."""
        return np.array([self.at(len(self) * step / count)[0] for step in range(count)])


def around_room(rng: StableRng, size: tuple[float, float, float]) -> Path:
    """Return a loop in a room of `size` [m]; the origin is in the middle of its floor."""
    reach_x, reach_y = 0.5 * size[0] - MARGIN, 0.5 * size[1] - MARGIN
    step = (1.0 if rng.chance(0.5) else -1.0) * 2.0 * math.pi / KNOTS
    start = rng.between(0.0, KNOTS)
    knots = []
    for knot in range(KNOTS):
        angle = step * (start + knot + rng.between(-0.15, 0.15))
        radius = rng.between(0.7, 1.0)
        knots.append((rounded(reach_x * radius * math.cos(angle)),
                      rounded(reach_y * radius * math.sin(angle)), rng.between(*HEIGHTS)))
    return Path(knots)


def around_block(rng: StableRng) -> Path:
    """Return a road around a block with the shape of an L, the origin in the middle of it.

    Five of its corners turn one way and one the other, all cut by the spline; between them it
    winds a little.
    """
    wide, deep = rng.between(90.0, 140.0), rng.between(90.0, 140.0)
    inner_x, inner_y = wide * rng.between(0.35, 0.65), deep * rng.between(0.35, 0.65)
    corners = [(0.0, 0.0), (wide, 0.0), (wide, inner_y), (inner_x, inner_y), (inner_x, deep),
               (0.0, deep)]
    if rng.chance(0.5):
        corners.reverse()
    knots = []
    for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
        along = end[0] - start[0], end[1] - start[1]
        length = abs(along[0]) + abs(along[1])
        pieces = round(length / SPACING)
        for piece in range(1, pieces):
            share, off = piece / pieces, rng.between(-BEND, BEND) / length
            knots.append((rounded(start[0] + share * along[0] - off * along[1] - 0.5 * wide),
                          rounded(start[1] + share * along[1] + off * along[0] - 0.5 * deep),
                          MOUNTED))
    return Path(knots)
