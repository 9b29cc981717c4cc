# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The reward that looks at a stretch of the trajectory."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.training.rewards import LEAST_SPAN, MOST, LocalReward, standing_of

FRAMES = 100


def walk(frames: int = FRAMES) -> np.ndarray:
    steps = np.random.default_rng(2).normal(0.1, 0.05, (frames, 3))
    return geometry.make_transform(np.tile(np.eye(3), (frames, 1, 1)), steps.cumsum(axis=0))


def drifting(truth: np.ndarray, drift: float) -> np.ndarray:
    """Return the walk in another world, its steps longer and longer."""
    steps = np.diff(truth[:, :3, 3], axis=0, prepend=0.0)
    grown = steps * np.exp(np.linspace(0.0, drift, len(steps)))[:, None]
    return geometry.make_transform(truth[:, :3, :3],
                                   3.0 * grown.cumsum(axis=0) @ geometry.exp_so3([1.0, 0.2, 0.3]))


def standing(estimate: np.ndarray, truth: np.ndarray) -> float:
    return standing_of(estimate[:, :3, 3], truth[:, :3, 3])


def test_drift_of_scale_is_charged_on_a_log_scale():
    truth = walk()
    standings = [standing(drifting(truth, drift), truth) for drift in (0.1, 0.2, 0.4)]
    assert standings[0] > standings[1] > standings[2]
    assert standings[0] - standings[1] == pytest.approx(np.log(2.0), abs=0.1)


def test_what_changes_is_rewarded_and_all_rewards_sum_up_to_where_one_stands():
    truth, reward = walk(), LocalReward(FRAMES, alpha=-0.25)
    good, bad = drifting(truth, 0.1), drifting(truth, 0.4)
    rewards = [reward(poses, truth, False) for poses in (good, bad, bad, good)]
    assert rewards[0] == pytest.approx(standing(good, truth)) and rewards[1] < -1.0
    assert rewards[2] == 0.0 and rewards[3] == -rewards[1]
    assert sum(rewards) == pytest.approx(reward.standing)
    assert reward(good, truth, True) == -0.25


def test_it_is_bounded_and_right_or_wrong_alike():
    truth, at_rest = walk(), np.tile(np.eye(4), (FRAMES, 1, 1))
    assert standing(truth, truth) == standing(at_rest, at_rest) == MOST
    assert standing(drifting(truth, 20.0), truth) == standing(at_rest, truth) == -MOST


def test_a_window_s_length_says_nothing():
    truth, reward = walk(LEAST_SPAN - 1), LocalReward(2 * FRAMES, alpha=-0.25)
    assert reward(drifting(truth, 5.0), truth, False) == 0.0
    assert reward(drifting(truth, 5.0), truth, True) == -0.25


def test_where_there_are_but_few_frames_two_thirds_of_them_tell():
    reward = LocalReward(30)
    for frames, told in ((19, False), (20, True)):
        truth = walk(frames)
        assert (reward(drifting(truth, 5.0), truth, False) != 0.0) == told
