# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the camera of a rendered sequence moves: a closed path, a changing pace, a roaming gaze.

Poses do not depend on how many are asked for, and are the same for ever: what comes out of the
maths library is rounded, so that its last digit never matters.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kfvo_ros.geometry import make_transform
from kfvo_ros.sequences.synthetic_textures import Dice

RATE = 30
"""Frames per second."""
QUANTUM = 2.0 ** -20
"""Positions [m] and quaternions are whole multiples of this."""

KNOTS = 9
MARGIN = 1.0
"""The path keeps this far from the walls [m]."""
HEIGHTS = (1.15, 1.75)
TREMBLE_POSITION, TREMBLE_ANGLE = 0.002, math.radians(0.08)
TREMBLE_BANDS = ((0.5, 1.0), (1.0, 2.0), (2.0, 4.0))
"""A hand shakes along and about every axis by one sine per band [Hz] of this amplitude."""
MAX_GAZE = math.radians(65.0)
"""The camera looks at most so far to the side of where it goes."""

PACE_RESPONSE = 0.25
"""Share of the way to a new speed, or gaze, that each of three low-passes covers per frame."""


@dataclass(frozen=True)
class Activity:
    """What the camera does for a while.

    ``seconds`` it lasts, ``speed`` [m/s] and ``gaze`` [deg] (how far the new viewing direction
    is from the path's or, when ``turns``, from the last one) are ranges; ``response`` as
    PACE_RESPONSE.
    """

    seconds: tuple[float, float]
    speed: tuple[float, float]
    gaze: tuple[float, float]
    response: float
    turns: bool = False


CRUISE = Activity((1.0, 2.0), (1.0, 1.5), (0.0, 25.0), 0.10)
WALK = Activity((0.8, 1.4), (0.8, 1.4), (0.0, 35.0), 0.15)
RUSH = Activity((0.7, 1.2), (1.8, 2.6), (20.0, 60.0), 0.20)
CREEP = Activity((0.7, 1.1), (0.1, 0.3), (0.0, 15.0), 0.10)
HOVER = Activity((0.6, 0.9), (0.0, 0.0), (0.0, 0.0), 0.15, turns=True)
TURN = Activity((0.8, 1.1), (0.0, 0.0), (20.0, 36.0), 0.18, turns=True)

STYLES = {'smooth': ((CRUISE,),),
          'fast': ((RUSH,), (RUSH,), (WALK,)),
          'mixed': ((WALK,), (RUSH,), (RUSH,), (CREEP,), (HOVER, TURN))}
"""Decks of activities: shuffled, played through, shuffled again."""


class Path:
    """A closed loop around the room: a uniform cubic B-spline, C2, inside its knots' hull.

    ``size`` (3,) is the room's [m]; the origin is in the middle of its floor.
    """

    def __init__(self, dice: Dice, size: tuple[float, float, float]) -> None:
        reach_x, reach_y = 0.5 * size[0] - MARGIN, 0.5 * size[1] - MARGIN
        way = -1.0 if dice.chance(0.5) else 1.0
        start = dice.between(0.0, 2.0 * math.pi)
        self._knots = []
        for knot in range(KNOTS):
            angle = start + way * 2.0 * math.pi * (knot + dice.between(-0.25, 0.25)) / KNOTS
            radius = dice.between(0.6, 1.0)
            self._knots.append((_rounded(reach_x * radius * math.cos(angle)),
                                _rounded(reach_y * radius * math.sin(angle)),
                                dice.between(*HEIGHTS)))

    def at(self, place: float) -> tuple[list[float], list[float]]:
        """Return position and its derivative at a place of [0, KNOTS), periodic."""
        segment = math.floor(place)
        t = place - segment
        r = 1.0 - t
        weights = (r * r * r / 6.0, (3.0 * t * t * (t - 2.0) + 4.0) / 6.0,
                   (3.0 * r * r * (r - 2.0) + 4.0) / 6.0, t * t * t / 6.0)
        slopes = (-0.5 * r * r, 0.5 * t * (3.0 * t - 4.0), 0.5 * r * (4.0 - 3.0 * r),
                  0.5 * t * t)
        position, derivative = [0.0] * 3, [0.0] * 3
        for weight, slope, knot in zip(weights, slopes, range(segment, segment + 4), strict=True):
            for axis, value in enumerate(self._knots[knot % KNOTS]):
                position[axis] += weight * value
                derivative[axis] += slope * value
        return position, derivative

    def positions(self, count: int) -> np.ndarray:
        """Return positions (count, 3) all along the loop."""
        return np.array([self.at(KNOTS * step / count)[0] for step in range(count)])


class Follower:
    """A value that follows its target without overshoot, its acceleration without a jump."""

    def __init__(self, value: float) -> None:
        self._stages = [value] * 3

    @property
    def value(self) -> float:
        """Where it is."""
        return self._stages[-1]

    def step(self, target: float, response: float) -> float:
        """Go on by one frame and return the new value."""
        for stage in range(3):
            self._stages[stage] += response * (target - self._stages[stage])
            target = self._stages[stage]
        return target


def move(dice: Dice, style: str, path: Path) -> Iterator[np.ndarray]:
    """Yield T_world_camera (4, 4), frame by frame, without end."""
    trembles = [Waves(dice, *TREMBLE_BANDS) for _ in range(6)]
    plan = _plan(dice, style)
    place = dice.between(0.0, KNOTS)
    speed, yaw, pitch, roll = (Follower(0.0) for _ in range(4))
    for frame, (activity, targets) in enumerate(plan):
        if frame == 0:
            speed, yaw, pitch, roll = (Follower(target) for target in targets)
        shake = [tremble.at(frame) for tremble in trembles]
        position, derivative = path.at(place)
        heading = math.atan2(derivative[1], derivative[0])
        yield _pose([p + TREMBLE_POSITION * s for p, s in zip(position, shake, strict=False)],
                    heading + yaw.value + TREMBLE_ANGLE * shake[3],
                    pitch.value + TREMBLE_ANGLE * shake[4],
                    roll.value + TREMBLE_ANGLE * shake[5])
        length = math.sqrt(derivative[0] * derivative[0] + derivative[1] * derivative[1]
                           + derivative[2] * derivative[2])
        place += speed.step(targets[0], PACE_RESPONSE) / (RATE * length)
        yaw.step(targets[1], activity.response)
        pitch.step(targets[2], activity.response)
        roll.step(targets[3], activity.response)


def _plan(dice: Dice, style: str) -> Iterator[tuple[Activity, tuple[float, ...]]]:
    """Yield, per frame, the activity and its targets: speed, and yaw, pitch, roll [rad]."""
    yaw = pitch = roll = 0.0
    while True:
        for activity in (each for group in dice.shuffled(list(STYLES[style])) for each in group):
            speed = dice.between(*activity.speed)
            change = math.radians(dice.between(*activity.gaze))
            change = -change if dice.chance(0.5) else change
            if activity.turns:
                yaw += -change if abs(yaw + change) > MAX_GAZE else change
            else:
                yaw, pitch, roll = (change, math.radians(dice.between(-14.0, 4.0)),
                                    math.radians(dice.between(-6.0, 6.0)))
            for _ in range(round(RATE * dice.between(*activity.seconds))):
                yield activity, (speed, yaw, pitch, roll)


class Waves:
    """A sum of sines of amplitude one, one in each band [Hz]."""

    def __init__(self, dice: Dice, *bands: tuple[float, float]) -> None:
        self._waves = [(2.0 * math.pi * dice.between(*band) / RATE,
                        dice.between(0.0, 2.0 * math.pi)) for band in bands]

    def at(self, frame: int) -> float:
        """Return the sum at a frame."""
        return sum(math.sin(phase + step * frame) for step, phase in self._waves)


def _pose(position: list[float], yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Return T_world_camera of a camera that looks along yaw (from x to y), pitch up, roll."""
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    cp, sp = math.cos(-0.5 * pitch), math.sin(-0.5 * pitch)
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    body = (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr)
    # From x forward, y left, z up to x right, y down, z forward: times (-1, 1, -1, 1) / 2.
    x, y, z, w = (_rounded(value) for value in (
        0.5 * (body[0] - body[1] - body[2] - body[3]),
        0.5 * (body[0] + body[1] - body[2] + body[3]),
        0.5 * (body[0] + body[1] + body[2] - body[3]),
        0.5 * (body[0] - body[1] + body[2] + body[3])))
    # Written out because a matrix product adds in an order of its library's choosing.
    s = 2.0 / (x * x + y * y + z * z + w * w)
    rotation = [[1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
                [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
                [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)]]
    return make_transform(np.array(rotation), np.array([_rounded(p) for p in position]))


def _rounded(value: float) -> float:
    return round(value / QUANTUM) * QUANTUM
