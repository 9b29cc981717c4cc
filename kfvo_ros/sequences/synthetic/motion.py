# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the camera of a rendered sequence moves: a changing pace, a roaming gaze, a shaking hand.

Or a car: then it looks ahead.

Poses do not depend on how many are asked for and are the same for ever.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kfvo_ros.geometry import make_transform
from kfvo_ros.sequences.synthetic.path import Path, rounded
from kfvo_ros.sequences.synthetic.rng import StableRng

RATE, RATES = 30, {'street': 10}
"""Frames per second, and of the tempers that have another rate."""
MAX_GAZE = math.radians(65.0)
"""The camera looks at most so far to the side of where it goes."""
PITCHES, ROLLS = (-14.0, 4.0), (-6.0, 6.0)
"""How it is held [deg]."""
PACE_RESPONSE = 0.25
"""Share of the way to a new speed that each of a Follower's stages covers per frame, on foot."""
TREMBLE_BANDS = ((0.5, 1.0), (1.0, 2.0), (2.0, 4.0))
TREMBLE_POSITION, TREMBLE_ANGLE = 0.001, math.radians(0.08)
"""A hand shakes along and about every axis by one sine per band [Hz] of this amplitude."""


@dataclass(frozen=True)
class Activity:
    """What the camera does for a while.

    Ranges of how many ``seconds`` it takes, of the ``speed`` [m/s] and of the ``gaze`` [deg],
    the angle of view with the path; ``response`` as PACE_RESPONSE, of the gaze, and ``pace``, of
    the speed. An activity that ``swings`` looks to the other side than before; one that ``turns``
    adds to the gaze.
    """

    seconds: tuple[float, float]
    speed: tuple[float, float]
    gaze: tuple[float, float]
    response: float
    swings: bool = False
    turns: bool = False
    pace: float = PACE_RESPONSE


CRUISE = Activity((0.8, 1.5), (1.2, 1.8), (5.0, 40.0), 0.12)
WALK = Activity((0.8, 1.3), (0.9, 1.5), (5.0, 40.0), 0.15)
RUSH = Activity((0.7, 1.2), (1.8, 2.4), (15.0, 50.0), 0.18)
DASH = Activity((0.5, 0.9), (1.4, 2.2), (40.0, 60.0), 0.40, swings=True)
CREEP = Activity((0.6, 0.9), (0.2, 0.35), (0.0, 15.0), 0.10)
HOVER = Activity((0.5, 0.8), (0.0, 0.0), (0.0, 0.0), 0.30, turns=True)
TURN = Activity((0.8, 1.1), (0.0, 0.0), (20.0, 34.0), 0.18, turns=True)
DRIVE = Activity((2.0, 4.0), (6.0, 10.0), (0.0, 0.0), 0.25, turns=True, pace=0.15)
HURRY = Activity((2.0, 4.0), (10.0, 14.0), (0.0, 0.0), 0.25, turns=True, pace=0.15)
CRAWL = Activity((1.0, 2.0), (2.0, 4.0), (0.0, 0.0), 0.25, turns=True, pace=0.15)
STOP = Activity((2.0, 3.0), (0.0, 0.0), (0.0, 0.0), 0.25, turns=True, pace=0.25)
DECKS = {'smooth': ((CRUISE,),),
         'fast': ((RUSH,), (RUSH,), (WALK,)),
         'mixed': ((WALK, RUSH), (RUSH,), (CREEP,), (HOVER, TURN, WALK)),
         'hectic': ((WALK, DASH), (DASH, DASH), (DASH,), (CREEP,), (HOVER, TURN, WALK)),
         'street': ((DRIVE,), (DRIVE, HURRY), (DRIVE,), (CRAWL,), (STOP, DRIVE))}
"""By temper: the first group comes first, then all groups, shuffled, again and again."""
Targets = tuple[float, float, float, float]
"""Speed [m/s], and the yaw from the path, pitch and roll [rad]."""


def move(rng: StableRng, temper: str, path: Path) -> Iterator[np.ndarray]:
    """Yield T_world_camera (4, 4), frame by frame, without end."""
    rate = rate_of(temper)
    trembles = [Waves(rng, rate, *TREMBLE_BANDS) for _ in range(6)]
    place = rng.between(0.0, len(path))
    followers: list[Follower] = []
    for frame, (targets, responses) in enumerate(_plan(rng, temper)):
        followers = followers or [Follower(target) for target in targets]
        speed, yaw, pitch, roll = (follower.value for follower in followers)
        position, derivative = path.at(place)
        shake = [tremble.at(frame) for tremble in trembles]
        yield _pose([position[axis] + TREMBLE_POSITION * shake[axis] for axis in range(3)],
                    math.atan2(derivative[1], derivative[0]) + yaw + TREMBLE_ANGLE * shake[3],
                    pitch + TREMBLE_ANGLE * shake[4], roll + TREMBLE_ANGLE * shake[5])
        place += speed / (rate * math.sqrt(sum(value * value for value in derivative)))
        for follower, target, share in zip(followers, targets, responses, strict=True):
            follower.step(target, share)


def rate_of(temper: str) -> int:
    """Return the frames per second."""
    return RATES.get(temper, RATE)


def _plan(rng: StableRng, temper: str) -> Iterator[tuple[Targets, Targets]]:
    """Yield, per frame, what to aim at and the share of the way to it that a stage covers."""
    yaw = pitch = roll = 0.0
    groups = list(DECKS[temper][:1])
    while True:
        for activity in (activity for group in groups for activity in group):
            speed, gaze = rng.between(*activity.speed), math.radians(
                rng.between(*activity.gaze))
            if yaw > 0.0 if activity.swings else rng.chance(0.5):
                gaze = -gaze
            if activity.turns:
                yaw += -gaze if abs(yaw + gaze) > MAX_GAZE else gaze
            else:
                yaw = gaze
                pitch, roll = (math.radians(rng.between(*limits)) for limits in (PITCHES, ROLLS))
            gazing = activity.response
            responses = activity.pace, gazing, gazing, gazing
            for _ in range(round(rate_of(temper) * rng.between(*activity.seconds))):
                yield (speed, yaw, pitch, roll), responses
        groups = rng.shuffled(DECKS[temper])


class Follower:
    """A value that follows its target without overshoot and without a jump in acceleration."""

    def __init__(self, value: float) -> None:
        self._stages = [value] * 3

    @property
    def value(self) -> float:
        """Where it is."""
        return self._stages[-1]

    def step(self, target: float, response: float) -> None:
        """Go on by one frame."""
        for stage, value in enumerate(self._stages):
            target = self._stages[stage] = value + response * (target - value)


class Waves:
    """A sum of sines of amplitude one, one in each band [Hz]."""

    def __init__(self, rng: StableRng, rate: float, *bands: tuple[float, float]) -> None:
        self._waves = [(2.0 * math.pi * rng.between(*band) / rate,
                        rng.between(0.0, 2.0 * math.pi)) for band in bands]

    def at(self, frame: int) -> float:
        """Return the sum at a frame."""
        return sum(math.sin(phase + step * frame) for step, phase in self._waves)


def _pose(position: list[float], yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Return T_world_camera of a camera that looks along yaw (from x to y), pitched up, rolled."""
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    cp, sp = math.cos(-0.5 * pitch), math.sin(-0.5 * pitch)
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    a, b, c, d = (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
                  sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr)
    # From x forward, y left, z up to x right, y down, z forward: times (-1, 1, -1, 1) / 2.
    x, y, z, w = (rounded(0.5 * value)
                  for value in (a - b - c - d, a + b - c + d, a + b + c - d, a - b + c + d))
    # Written out because a matrix product adds in an order of its library's choosing.
    s = 2.0 / (x * x + y * y + z * z + w * w)
    rotation = [[1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
                [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
                [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)]]
    return make_transform(np.array(rotation), np.array([rounded(value) for value in position]))
