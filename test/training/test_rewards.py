# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The reward of a keyframe decision."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.training.rewards import ALPHA, PaperReward, align

SCALE = 2.5
ROTATION = geometry.exp_so3([0.3, -1.1, 0.4])
SHIFT = np.array([4.0, -2.0, 1.0])


def poses(positions: np.ndarray, seed: int = 0) -> np.ndarray:
    turns = np.random.default_rng(seed).normal(0.0, 0.3, (len(positions), 3))
    return geometry.make_transform(geometry.exp_so3(turns), positions)


def seen(truth: np.ndarray) -> np.ndarray:
    """Return true poses as an odometry tells them, in a world and a unit of its own."""
    world = truth.copy()
    world[:, :3, :3] = ROTATION.T @ truth[:, :3, :3]
    world[:, :3, 3] = (truth[:, :3, 3] - SHIFT) @ ROTATION / SCALE
    return world


CURVE = np.random.default_rng(1).normal(size=(8, 3))
LINE = np.outer(np.linspace(0.0, 1.4, 8), [0.6, 0.0, 0.8])
POINT = np.zeros((8, 3))


@pytest.mark.parametrize('positions', [CURVE, LINE, LINE + 1e-3 * CURVE])
def test_a_right_window_has_no_error(positions):
    truth = poses(positions)
    reward = PaperReward()
    assert reward.error(seen(truth), truth) < 1e-9
    assert reward(seen(truth), truth, keep=False) == pytest.approx(0.01 * 0.2)
    assert reward(seen(truth), truth, keep=True) - reward(seen(truth), truth, keep=False) \
        == pytest.approx(0.005 * ALPHA, rel=1e-6)


@pytest.mark.parametrize('positions', [CURVE, LINE])
def test_error_is_that_of_the_newest_frame_in_metres(positions):
    truth = poses(positions)
    estimate = seen(truth)
    estimate[-1, :3, 3] += np.array([0.0, 0.3, 0.0]) / SCALE
    estimate[5, :3, 3] += 7.0  # neither aligned nor newest
    reward = PaperReward()
    assert reward.error(estimate, truth) == pytest.approx(0.3)
    assert reward(estimate, truth, keep=False) == pytest.approx(0.01 * (0.2 - 0.3))
    estimate[-1, :3, 3] += 50.0
    assert reward(estimate, truth, keep=False) == pytest.approx(-0.01)


def test_a_line_leaves_the_rotation_about_it_to_the_orientations():
    truth = poses(LINE)
    truth[-1, :3, 3] += [0.0, 0.5, 0.0]  # the newest frame leaves the line
    assert PaperReward().error(seen(truth), truth) < 1e-9
    # Positions alone would not have told it: noise of a tenth of a millimetre turns them.
    noisy = seen(truth)
    noisy[:, :3, 3] += 1e-4 * CURVE
    alone = geometry.umeyama(noisy[:5, :3, 3], truth[:5, :3, 3])
    assert np.linalg.norm(alone.transform_points(noisy[-1:, :3, 3])[0] - truth[-1, :3, 3]) > 0.05
    assert PaperReward().error(noisy, truth) < 0.01


def test_at_rest_the_last_scale_is_kept():
    reward, moving, resting = PaperReward(), poses(CURVE), poses(POINT)
    reward.error(seen(moving), moving)
    estimate = seen(resting)
    estimate[-1, :3, 3] += np.array([0.2, 0.0, 0.0]) / SCALE
    assert reward.error(estimate, resting) == pytest.approx(0.2)
    fresh = PaperReward()
    assert fresh.error(estimate, resting) == pytest.approx(0.2 / SCALE)


def test_a_window_that_shrank_to_a_point_is_no_division_by_zero():
    truth = poses(CURVE)
    estimate = seen(truth)
    estimate[:, :3, 3] = 1.0
    assert np.isfinite(PaperReward()(estimate, truth, keep=True))
    assert align(estimate[:5], truth[:5], 3.0).scale == 3.0


def test_a_penalty_turns_the_sign():
    truth = poses(CURVE)
    assert PaperReward(-ALPHA)(seen(truth), truth, keep=True) \
        == pytest.approx(0.002 - 0.005 * ALPHA, abs=1e-12)
