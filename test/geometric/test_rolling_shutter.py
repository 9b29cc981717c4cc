# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test the correction of a simulated rolling shutter against the same camera's global shutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odometry_scenes import certain_tracks

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric.rolling_shutter import MAX_GAP_NS, RollingShutter
from kfvo_ros.camera import Camera

READOUT = 0.03
CAMERA = Camera(640, 480, 517.0, 517.0, 319.5, 239.5, readout_s=READOUT)
FRAME_NS = 33_333_333


class TurningCamera:
    """A hand-held camera that sways by 20 degrees at half a hertz, in a room of 1 to 2.5 m."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._phases = rng.uniform(0.0, 2.0 * np.pi, 6)
        directions = np.column_stack([rng.uniform(-1.5, 1.5, (4000, 2)), np.ones(4000)])
        self.points = directions * rng.uniform(1.0, 2.5, (4000, 1))

    def project(self, seconds: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of all points at times `seconds` (N,) [s]."""
        waves = np.sin(2.0 * np.pi * 0.5 * seconds[:, None] + self._phases)
        R = geometry.exp_so3(waves[:, :3] * [0.35, 0.45, 0.3])
        local = np.einsum('pji,pj->pi', R, self.points - 0.06 * waves[:, 3:])
        return local[:, :2] / np.maximum(local[:, 2:], 0.1) * CAMERA.fx + (CAMERA.cx, CAMERA.cy)

    def expose(self, second: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (N, 2) of the points for a rolling and for a global shutter."""
        still = self.project(np.full(len(self.points), second))
        rolling = still
        for _ in range(6):
            rows = np.clip(rolling[:, 1] + 0.5, 0.0, CAMERA.height) / CAMERA.height
            rolling = self.project(second + READOUT * (rows - 0.5))
        return rolling, still


def inside(pixels: np.ndarray) -> np.ndarray:
    return ((pixels > 4.0) & (pixels < (CAMERA.width - 4, CAMERA.height - 4))).all(axis=1)


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('noise', [0.0, 0.2])
def test_turning_camera_is_corrected_to_one_pixel(seed, noise):
    camera, shutter = TurningCamera(seed), RollingShutter(CAMERA)
    rng = np.random.default_rng(seed)
    before, after = [], []
    for index in range(45):
        rolling, still = camera.expose(index * FRAME_NS * 1e-9)
        ids = np.flatnonzero(inside(rolling))[::3]
        rolling = rolling + noise * rng.normal(size=rolling.shape)
        corrected = shutter.correct(1 + index * FRAME_NS, certain_tracks(ids, rolling[ids]))
        if index >= 2:
            before.append(np.linalg.norm(rolling[ids] - still[ids], axis=1))
            after.append(np.linalg.norm(corrected - still[ids], axis=1))
    before, after = np.concatenate(before), np.concatenate(after)
    assert np.percentile(before, 90) > 3.0
    assert np.percentile(after, 95) < 1.0
    assert np.median(after) < 0.25 * np.median(before)


def test_new_tracks_are_corrected_by_the_motion_around_them():
    camera, shutter = TurningCamera(1), RollingShutter(CAMERA)
    known: set[int] = set()
    errors, untouched = [], []
    for index in range(12):
        rolling, still = camera.expose(index * FRAME_NS * 1e-9)
        ids = np.flatnonzero(inside(rolling))
        ids = ids[(ids % 12 < index + 1) & (ids % 4 == 0)]
        corrected = shutter.correct(1 + index * FRAME_NS, certain_tracks(ids, rolling[ids]))
        new = ~np.isin(ids, list(known))
        known.update(ids.tolist())
        if index >= 3 and new.any():
            errors.append(np.linalg.norm(corrected - still[ids], axis=1)[new])
            untouched.append(np.linalg.norm(rolling - still, axis=1)[ids[new]])
    assert len(np.concatenate(errors)) > 20
    assert np.median(np.concatenate(errors)) < 0.3 * np.median(np.concatenate(untouched))


def test_global_shutter_is_unchanged():
    camera, shutter = TurningCamera(0), RollingShutter(replace(CAMERA, readout_s=0.0))
    for index in range(4):
        rolling, _ = camera.expose(index * FRAME_NS * 1e-9)
        tracks = certain_tracks(np.arange(len(rolling)), rolling)
        assert shutter.correct(1 + index * FRAME_NS, tracks) is tracks.pixels


def test_tracks_are_unchanged_without_an_image_velocity():
    camera = TurningCamera(0)
    first, second = (camera.expose(index * FRAME_NS * 1e-9)[0] for index in range(2))
    ids = np.flatnonzero(inside(first) & inside(second))
    for stamp_ns, kept in [(1 + FRAME_NS, ids[:10]), (2 + MAX_GAP_NS, ids), (1, ids)]:
        shutter = RollingShutter(CAMERA)
        start = certain_tracks(ids, first[ids])
        assert np.array_equal(shutter.correct(1, start), start.pixels)
        later = certain_tracks(kept, second[kept])
        assert np.array_equal(shutter.correct(stamp_ns, later), later.pixels)


def test_velocities_span_at_least_a_readout():
    camera = TurningCamera(0)
    first, second = (camera.expose(index * FRAME_NS * 1e-9)[0] for index in range(2))
    ids = np.flatnonzero(inside(first) & inside(second))
    corrected = []
    for gap_s in (READOUT, 0.1 * READOUT, 1e-9):
        shutter = RollingShutter(CAMERA)
        shutter.correct(1, certain_tracks(ids, first[ids]))
        corrected.append(shutter.correct(1 + round(gap_s * 1e9), certain_tracks(ids, second[ids])))
    assert np.abs(corrected[0] - second[ids]).max() > 1.0
    assert np.array_equal(corrected[0], corrected[1])
    assert np.array_equal(corrected[0], corrected[2])


def test_tracks_of_a_still_camera_are_unchanged():
    camera, shutter = TurningCamera(0), RollingShutter(CAMERA)
    _, still = camera.expose(0.0)
    ids = np.flatnonzero(inside(still))
    for index in range(3):
        corrected = shutter.correct(1 + index * FRAME_NS, certain_tracks(ids, still[ids]))
        np.testing.assert_allclose(corrected, still[ids], atol=1e-9)
