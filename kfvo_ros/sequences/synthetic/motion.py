# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Camera motion of rendered sequences: a random schedule of motion primitives along a path.

A hand-held camera changes its speed, looks around and trembles; a camera on a car looks ahead.
A pose does not depend on the length of the sequence and is the same on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kfvo_ros.geometry import make_transform
from kfvo_ros.sequences.synthetic.rng import StableRng, quantise

FRAME_RATES_HZ = {'smooth': 30, 'fast': 30, 'mixed': 30, 'hectic': 30, 'street': 10}
"""By style."""
MAX_YAW_OFFSET = math.radians(65.0)
"""Limit of the angle between the viewing direction and the path."""
PITCHES_DEG, ROLLS_DEG = (-14.0, 4.0), (-6.0, 6.0)
WALKING_SMOOTHING = 0.25
"""Smoothing of the speed on foot."""
TREMOR_BANDS_HZ = ((0.5, 1.0), (1.0, 2.0), (2.0, 4.0))
TREMOR_POSITION, TREMOR_ANGLE = 0.001, math.radians(0.08)
"""Amplitudes [m, rad] of hand tremor: one sine per band along and about every axis."""


@dataclass(frozen=True)
class MotionPrimitive:
    """A phase of camera motion with targets drawn from ranges.

    The yaw offset is the angle between the viewing direction and the path. Its side is random,
    or opposite to the last one if the primitive ``alternates``. A primitive that
    ``accumulates`` adds it to the last one and keeps pitch and roll. The smoothings are those
    of `LowPassFilter.update`, of the attitude and of the speed.
    """

    duration_s: tuple[float, float]
    speed_m_s: tuple[float, float]
    yaw_offset_deg: tuple[float, float]
    attitude_smoothing: float
    alternates: bool = False
    accumulates: bool = False
    speed_smoothing: float = WALKING_SMOOTHING


CRUISE = MotionPrimitive((0.8, 1.5), (1.2, 1.8), (5.0, 40.0), 0.12)
WALK = MotionPrimitive((0.8, 1.3), (0.9, 1.5), (5.0, 40.0), 0.15)
RUSH = MotionPrimitive((0.7, 1.2), (1.8, 2.4), (15.0, 50.0), 0.18)
DASH = MotionPrimitive((0.5, 0.9), (1.4, 2.2), (40.0, 60.0), 0.40, alternates=True)
CREEP = MotionPrimitive((0.6, 0.9), (0.2, 0.35), (0.0, 15.0), 0.10)
HOVER = MotionPrimitive((0.5, 0.8), (0.0, 0.0), (0.0, 0.0), 0.30, accumulates=True)
TURN = MotionPrimitive((0.8, 1.1), (0.0, 0.0), (20.0, 34.0), 0.18, accumulates=True)
DRIVE = MotionPrimitive((2.0, 4.0), (6.0, 10.0), (0.0, 0.0), 0.25, accumulates=True,
                        speed_smoothing=0.15)
HURRY = MotionPrimitive((2.0, 4.0), (10.0, 14.0), (0.0, 0.0), 0.25, accumulates=True,
                        speed_smoothing=0.15)
CRAWL = MotionPrimitive((1.0, 2.0), (2.0, 4.0), (0.0, 0.0), 0.25, accumulates=True,
                        speed_smoothing=0.15)
STOP = MotionPrimitive((2.0, 3.0), (0.0, 0.0), (0.0, 0.0), 0.25, accumulates=True,
                       speed_smoothing=0.25)
SCHEDULES = {'smooth': ((CRUISE,),),
             'fast': ((RUSH,), (RUSH,), (WALK,)),
             'mixed': ((WALK, RUSH), (RUSH,), (CREEP,), (HOVER, TURN, WALK)),
             'hectic': ((WALK, DASH), (DASH, DASH), (DASH,), (CREEP,), (HOVER, TURN, WALK)),
             'street': ((DRIVE,), (DRIVE, HURRY), (DRIVE,), (CRAWL,), (STOP, DRIVE))}
"""By style: the first group comes first, then all groups in random order, repeatedly."""
Targets = tuple[float, float, float, float]
"""Speed [m/s], and the yaw offset from the path, pitch and roll [rad]."""


class ClosedSpline:
    """A closed uniform cubic B-spline through a world with z up [m].

    It has two continuous derivatives and stays inside the hull of its control points (N, 3).
    A parameter of 1 is one control point further; the spline closes every len(self).
    """

    def __init__(self, control_points: Sequence[tuple[float, float, float]]) -> None:
        self._control_points = control_points

    def __len__(self) -> int:
        return len(self._control_points)

    def evaluate(self, parameter: float) -> tuple[list[float], list[float]]:
        """Return position and derivative at a parameter."""
        segment = math.floor(parameter)
        t = parameter - segment
        r = 1.0 - t
        weights = (r * r * r / 6.0, (3.0 * t * t * (t - 2.0) + 4.0) / 6.0,
                   (3.0 * r * r * (r - 2.0) + 4.0) / 6.0, t * t * t / 6.0)
        slopes = (-0.5 * r * r, 0.5 * t * (3.0 * t - 4.0), 0.5 * r * (4.0 - 3.0 * r),
                  0.5 * t * t)
        position, derivative = [0.0] * 3, [0.0] * 3
        for offset, (weight, slope) in enumerate(zip(weights, slopes, strict=True)):
            for axis, value in enumerate(self._control_points[(segment + offset) % len(self)]):
                position[axis] += weight * value
                derivative[axis] += slope * value
        return position, derivative

    def sample(self, count: int) -> np.ndarray:
        """Return positions (count, 3) at regular parameters all along the loop."""
        return np.array([self.evaluate(len(self) * step / count)[0] for step in range(count)])


class LowPassFilter:
    """Three first-order low-pass filters in series: no overshoot, continuous acceleration."""

    def __init__(self, value: float) -> None:
        self._stages = [value] * 3

    @property
    def value(self) -> float:
        """The output."""
        return self._stages[-1]

    def update(self, target: float, smoothing: float) -> None:
        """Advance by one frame.

        Each stage covers the share `smoothing` of the way to its input.
        """
        for stage, value in enumerate(self._stages):
            target = self._stages[stage] = value + smoothing * (target - value)


class SineSum:
    """A sum of sines of amplitude one and random phase, one in each frequency band [Hz]."""

    def __init__(self, rng: StableRng, frame_rate_hz: float, *bands: tuple[float, float]) -> None:
        self._waves = [(2.0 * math.pi * rng.between(*band) / frame_rate_hz,
                        rng.between(0.0, 2.0 * math.pi)) for band in bands]

    def at(self, frame: int) -> float:
        """Return the sum at a frame."""
        return sum(math.sin(phase + step * frame) for step, phase in self._waves)


def camera_poses(rng: StableRng, style: str, path: ClosedSpline) -> Iterator[np.ndarray]:
    """Yield T_world_camera (4, 4), frame by frame, without end."""
    rate = FRAME_RATES_HZ[style]
    tremors = [SineSum(rng, rate, *TREMOR_BANDS_HZ) for _ in range(6)]
    parameter = rng.between(0.0, len(path))
    filters: list[LowPassFilter] = []
    for frame, (targets, smoothings) in enumerate(_schedule_targets(rng, style)):
        filters = filters or [LowPassFilter(target) for target in targets]
        speed, yaw, pitch, roll = (each.value for each in filters)
        position, derivative = path.evaluate(parameter)
        shake = [tremor.at(frame) for tremor in tremors]
        yield _make_pose([position[axis] + TREMOR_POSITION * shake[axis] for axis in range(3)],
                         math.atan2(derivative[1], derivative[0]) + yaw + TREMOR_ANGLE * shake[3],
                         pitch + TREMOR_ANGLE * shake[4], roll + TREMOR_ANGLE * shake[5])
        parameter += speed / (rate * math.sqrt(sum(value * value for value in derivative)))
        for each, target, smoothing in zip(filters, targets, smoothings, strict=True):
            each.update(target, smoothing)


def _schedule_targets(rng: StableRng, style: str) -> Iterator[tuple[Targets, Targets]]:
    """Yield, per frame, the targets and the smoothing of each."""
    yaw = pitch = roll = 0.0
    groups = list(SCHEDULES[style][:1])
    while True:
        for primitive in (primitive for group in groups for primitive in group):
            speed, offset = rng.between(*primitive.speed_m_s), math.radians(
                rng.between(*primitive.yaw_offset_deg))
            if yaw > 0.0 if primitive.alternates else rng.chance(0.5):
                offset = -offset
            if primitive.accumulates:
                yaw += -offset if abs(yaw + offset) > MAX_YAW_OFFSET else offset
            else:
                yaw = offset
                pitch, roll = (math.radians(rng.between(*limits))
                               for limits in (PITCHES_DEG, ROLLS_DEG))
            attitude = primitive.attitude_smoothing
            smoothings = primitive.speed_smoothing, attitude, attitude, attitude
            for _ in range(round(FRAME_RATES_HZ[style] * rng.between(*primitive.duration_s))):
                yield (speed, yaw, pitch, roll), smoothings
        groups = rng.shuffled(SCHEDULES[style])


def _make_pose(position: list[float], yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Return T_world_camera for a viewing direction: yaw (from x to y), pitch up, and roll."""
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    cp, sp = math.cos(-0.5 * pitch), math.sin(-0.5 * pitch)
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    a, b, c, d = (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
                  sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr)
    # From x forward, y left, z up to x right, y down, z forward: times (-1, 1, -1, 1) / 2.
    x, y, z, w = (quantise(0.5 * value)
                  for value in (a - b - c - d, a + b - c + d, a + b + c - d, a - b + c + d))
    # Written out because libraries order the sums of a matrix product differently.
    s = 2.0 / (x * x + y * y + z * z + w * w)
    rotation = [[1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
                [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
                [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)]]
    return make_transform(np.array(rotation), np.array([quantise(value) for value in position]))
