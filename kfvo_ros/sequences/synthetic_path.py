# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The closed loop on which the camera of a rendered sequence goes around its room."""

from __future__ import annotations

import math

import numpy as np

from kfvo_ros.sequences.synthetic_random import Dice

QUANTUM = 2.0 ** -20
"""Positions [m] and quaternions are whole multiples of this."""
KNOTS = 9
MARGIN = 1.0
"""The path keeps this far from the walls [m]."""
HEIGHTS = (1.15, 1.75)


def rounded(value: float) -> float:
    """Return a multiple of QUANTUM: the last digits of a maths library are not for ever."""
    return round(value / QUANTUM) * QUANTUM


class Path:
    """A uniform cubic B-spline: two continuous derivatives, inside the hull of its knots.

    ``size`` (3,) is the room's [m]; the origin is in the middle of its floor.
    """

    def __init__(self, dice: Dice, size: tuple[float, float, float]) -> None:
        reach_x, reach_y = 0.5 * size[0] - MARGIN, 0.5 * size[1] - MARGIN
        step = (1.0 if dice.chance(0.5) else -1.0) * 2.0 * math.pi / KNOTS
        start = dice.between(0.0, KNOTS)
        self._knots = []
        for knot in range(KNOTS):
            angle = step * (start + knot + dice.between(-0.15, 0.15))
            radius = dice.between(0.7, 1.0)
            self._knots.append((rounded(reach_x * radius * math.cos(angle)),
                                rounded(reach_y * radius * math.sin(angle)),
                                dice.between(*HEIGHTS)))

    def at(self, place: float) -> tuple[list[float], list[float]]:
        """Return position and derivative at a place; the loop closes every KNOTS."""
        segment = math.floor(place)
        t = place - segment
        r = 1.0 - t
        weights = (r * r * r / 6.0, (3.0 * t * t * (t - 2.0) + 4.0) / 6.0,
                   (3.0 * r * r * (r - 2.0) + 4.0) / 6.0, t * t * t / 6.0)
        slopes = (-0.5 * r * r, 0.5 * t * (3.0 * t - 4.0), 0.5 * r * (4.0 - 3.0 * r),
                  0.5 * t * t)
        position, derivative = [0.0] * 3, [0.0] * 3
        for offset, (weight, slope) in enumerate(zip(weights, slopes, strict=True)):
            for axis, value in enumerate(self._knots[(segment + offset) % KNOTS]):
                position[axis] += weight * value
                derivative[axis] += slope * value
        return position, derivative

    def positions(self, count: int) -> np.ndarray:
        """Return positions (count, 3) all along the loop."""
        return np.array([self.at(KNOTS * step / count)[0] for step in range(count)])
