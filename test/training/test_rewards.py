# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rewards of a keyframe decision: the paper's, on a window, and the local one."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.training.rewards import ALPHA, LocalReward, PaperReward, align, trajectory_quality

SCALE = 2.5
ROTATION = geometry.exp_so3([0.3, -1.1, 0.4])
SHIFT = np.array([4.0, -2.0, 1.0])


def poses(positions: np.ndarray, seed: int = 0) -> np.ndarray:
    turns = np.random.default_rng(seed).normal(0.0, 0.3, (len(positions), 3))
    return geometry.make_transform(geometry.exp_so3(turns), positions)


def estimate_of(truth: np.ndarray) -> np.ndarray:
    """Return true poses in the world and the unit of an odometry."""
    world = truth.copy()
    world[:, :3, :3] = ROTATION.T @ truth[:, :3, :3]
    world[:, :3, 3] = (truth[:, :3, 3] - SHIFT) @ ROTATION / SCALE
    return world


CURVE = np.random.default_rng(1).normal(size=(8, 3))
LINE = np.outer(np.linspace(0.0, 1.4, 8), [0.6, 0.0, 0.8])
POINT = np.zeros((8, 3))
FRAMES = 100


@pytest.mark.parametrize('positions', [CURVE, LINE, LINE + 1e-3 * CURVE])
def test_a_correct_window_has_no_error(positions):
    truth = poses(positions)
    reward = PaperReward()
    assert reward.error(estimate_of(truth), truth) < 1e-9
    dropped, kept = (reward(estimate_of(truth), truth, keep) for keep in (False, True))
    assert dropped == pytest.approx(0.01 * 0.2)
    assert kept - dropped == pytest.approx(0.005 * 2.5e-5, rel=1e-6)


@pytest.mark.parametrize('positions', [CURVE, LINE])
def test_the_error_is_that_of_the_newest_frame_in_metres(positions):
    truth = poses(positions)
    estimate = estimate_of(truth)
    estimate[-1, :3, 3] += np.array([0.0, 0.3, 0.0]) / SCALE
    estimate[5, :3, 3] += 7.0  # neither aligned nor newest
    reward = PaperReward()
    assert reward.error(estimate, truth) == pytest.approx(0.3)
    assert reward(estimate, truth, keep=False) == pytest.approx(0.01 * (0.2 - 0.3))
    estimate[-1, :3, 3] += 50.0
    assert reward(estimate, truth, keep=False) == pytest.approx(-0.01)


@pytest.mark.parametrize(('frame', 'is_aligned'), [(0, True), (4, True), (5, False), (6, False)])
def test_the_first_five_frames_are_aligned(frame, is_aligned):
    truth = poses(CURVE)
    estimate = estimate_of(truth)
    estimate[frame, :3, 3] += 0.5
    assert (PaperReward().error(estimate, truth) > 0.01) == is_aligned


def test_of_collinear_positions_the_orientations_give_the_rotation():
    truth = poses(LINE)
    truth[-1, :3, 3] += [0.0, 0.5, 0.0]  # the newest frame leaves the line
    assert PaperReward().error(estimate_of(truth), truth) < 1e-9
    # Positions alone do not fix the rotation: noise of a tenth of a millimetre turns them.
    noisy = estimate_of(truth)
    noisy[:, :3, 3] += 1e-4 * CURVE
    alone = geometry.umeyama(noisy[:5, :3, 3], truth[:5, :3, 3])
    assert np.linalg.norm(alone.transform_points(noisy[-1:, :3, 3])[0] - truth[-1, :3, 3]) > 0.05
    assert PaperReward().error(noisy, truth) < 0.01


def test_at_rest_the_last_scale_is_kept():
    reward, moving, resting = PaperReward(), poses(CURVE), poses(POINT)
    reward.error(estimate_of(moving), moving)
    estimate = estimate_of(resting)
    estimate[-1, :3, 3] += np.array([0.2, 0.0, 0.0]) / SCALE
    assert reward.error(estimate, resting) == pytest.approx(0.2)
    fresh = PaperReward()
    assert fresh.error(estimate, resting) == pytest.approx(0.2 / SCALE)


def test_a_window_that_shrank_to_a_point_is_no_division_by_zero():
    truth = poses(CURVE)
    estimate = estimate_of(truth)
    estimate[:, :3, 3] = 1.0
    assert np.isfinite(PaperReward()(estimate, truth, keep=True))
    assert align(estimate[:5], truth[:5], 3.0).scale == 3.0


def test_a_penalty_turns_the_sign():
    truth = poses(CURVE)
    assert PaperReward(-ALPHA)(estimate_of(truth), truth, keep=True) \
        == pytest.approx(0.002 - 0.005 * ALPHA, abs=1e-12)


@pytest.mark.parametrize(('error', 'expected'), [
    (0.0, 2e-3), (0.199, 1e-5), (0.2, 0.0), (0.201, -1e-5), (1.19, -9.9e-3), (1.2, -1e-2),
    (1.21, -1e-2)])
def test_the_reward_is_zero_at_20_cm_and_its_least_at_1_2_m(error, expected):
    truth = poses(CURVE)
    estimate = estimate_of(truth)
    estimate[-1, :3, 3] += np.array([error, 0.0, 0.0]) @ ROTATION / SCALE
    assert PaperReward(0.0)(estimate, truth, keep=False) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(('motion_m', 'expected'), [
    (0.0099, 7.0), (0.01, SCALE), (0.0101, SCALE)])
def test_below_a_motion_of_1_cm_the_scale_is_kept(motion_m, expected):
    positions = np.outer(np.linspace(0.0, motion_m, 5), [1.0, 0.0, 0.0])
    truth = poses(positions)
    assert align(estimate_of(truth), truth, 7.0).scale == pytest.approx(expected)


@pytest.mark.parametrize(('ratio', 'is_line'), [(0.0499, True), (0.0501, False)])
def test_below_a_ratio_of_5_percent_positions_are_a_line(ratio, is_line):
    along, across = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]), np.array([1.0, 0.0, -2.0, 0.0, 1.0])
    across *= ratio * np.linalg.norm(along) / np.linalg.norm(across)
    truth = poses(np.column_stack([along, across, np.zeros(5)]))
    estimate = estimate_of(truth)
    tilt = geometry.exp_so3([0.5, 0.0, 0.0])
    # The positions still have the rotation ROTATION, the orientations now another one.
    estimate[:, :3, :3] = tilt.T @ estimate[:, :3, :3]
    expected = ROTATION @ tilt if is_line else ROTATION
    np.testing.assert_allclose(align(estimate, truth, 1.0).rotation, expected, atol=1e-9)


# The local reward


def random_walk(frames: int = FRAMES) -> np.ndarray:
    steps = np.random.default_rng(2).normal(0.1, 0.05, (frames, 3))
    return geometry.make_transform(np.tile(np.eye(3), (frames, 1, 1)), steps.cumsum(axis=0))


def drifting(truth: np.ndarray, drift: float) -> np.ndarray:
    """Return the trajectory in another world, with steps that grow by exp(drift)."""
    steps = np.diff(truth[:, :3, 3], axis=0, prepend=0.0)
    grown = steps * np.exp(np.linspace(0.0, drift, len(steps)))[:, None]
    return geometry.make_transform(truth[:, :3, :3],
                                   3.0 * grown.cumsum(axis=0) @ geometry.exp_so3([1.0, 0.2, 0.3]))


def quality(estimate: np.ndarray, truth: np.ndarray) -> float:
    return trajectory_quality(estimate[:, :3, 3], truth[:, :3, 3])


def test_quality_falls_with_the_logarithm_of_scale_drift():
    truth = random_walk()
    qualities = [quality(drifting(truth, drift), truth) for drift in (0.1, 0.2, 0.4)]
    assert qualities[0] > qualities[1] > qualities[2]
    assert qualities[0] - qualities[1] == pytest.approx(np.log(2.0), abs=0.1)


def test_rewards_are_changes_of_quality_and_sum_up_to_it():
    truth, reward = random_walk(), LocalReward(FRAMES, alpha=-0.25)
    good, bad = drifting(truth, 0.1), drifting(truth, 0.4)
    rewards = [reward(poses, truth, False) for poses in (good, bad, bad, good)]
    assert rewards[0] == pytest.approx(quality(good, truth)) and rewards[1] < -1.0
    assert rewards[2] == 0.0 and rewards[3] == -rewards[1]
    assert sum(rewards) == pytest.approx(reward.quality)
    assert reward(good, truth, True) == -0.25


def test_quality_is_bounded():
    truth, at_rest = random_walk(), np.tile(np.eye(4), (FRAMES, 1, 1))
    assert quality(truth, truth) == quality(at_rest, at_rest) == 3.0
    assert quality(drifting(truth, 20.0), truth) == quality(at_rest, truth) == -3.0


def test_too_few_frames_leave_the_quality():
    truth, reward = random_walk(99), LocalReward(2 * FRAMES, alpha=-0.25)
    assert reward(drifting(truth, 5.0), truth, False) == 0.0
    assert reward(drifting(truth, 5.0), truth, True) == -0.25


@pytest.mark.parametrize(('span', 'frames'), [
    (30, 20), (73, 49), (140, 93), (149, 99), (150, 100), (300, 100), (1000, 100)])
def test_rewards_begin_after_100_frames_or_two_thirds_of_the_span(span, frames):
    for count, rewarded in ((frames - 1, False), (frames, True)):
        truth = random_walk(count)
        assert (LocalReward(span)(drifting(truth, 5.0), truth, False) != 0.0) == rewarded


def wavy_line(length: float, rmse: float) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (8, 3) with this RMSE after Sim(3) alignment, and a straight line."""
    true = np.zeros((8, 3))
    true[:, 0] = np.linspace(-0.5 * length, 0.5 * length, 8)
    variance = np.mean(true[:, 0] ** 2)
    # The best rotation is none and the best scale v / (v + a^2), for an amplitude a.
    amplitude = rmse * np.sqrt(variance / (variance - rmse ** 2))
    return true + np.outer([1, -1, -1, 1, 1, -1, -1, 1], [0.0, amplitude, 0.0]), true


@pytest.mark.parametrize(('length', 'share', 'expected'), [
    (0.5, 0.99, -np.log(0.99)), (0.5, 1.01, -np.log(1.01)),
    (200.0, 0.99, -np.log(0.99)), (200.0, 1.01, -np.log(1.01)),
    (10.0, np.exp(2.99), -2.99), (10.0, np.exp(3.01), -3.0),
    (10.0, np.exp(-2.99), 2.99), (10.0, np.exp(-3.01), 3.0)])
def test_quality_is_zero_at_an_error_of_3_permille_of_the_path_and_2_mm(length, share, expected):
    estimated, true = wavy_line(length, share * (0.003 * length + 0.002))
    assert trajectory_quality(estimated, true) == pytest.approx(expected, abs=1e-9)
