# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a benchmark says of an estimate, and what it leaves unsaid."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from trajectories import along_x, disturbed, freiburg1_rpy, trajectory, wandering

from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation.metrics import (
    absolute_trajectory_error,
    constant_position,
    odometry_drift,
    relative_pose_error,
    straight_line,
)
from kfvo_ros.evaluation.scoring import Scores, score
from kfvo_ros.trajectory import Trajectory

KITTI = {'kitti_trans_percent', 'kitti_rot_deg_per_100m'}


def undefined(scores: Scores) -> set[str]:
    """Return the names of what has no value."""
    return {name for name, value in asdict(scores).items() if value is None}


def test_scores_are_the_metrics():
    truth = wandering(0, 600)
    estimate = disturbed(truth, 7)
    scores = score(estimate, truth)
    aligned = absolute_trajectory_error(estimate, truth)
    second = relative_pose_error(estimate, truth, 1.0, 'seconds')
    metre = relative_pose_error(estimate, truth, 1.0, 'metres')
    drift = odometry_drift(estimate, truth)
    assert scores == Scores(
        aligned.rmse, aligned.alignment.scale,
        absolute_trajectory_error(estimate, truth, with_scale=False).rmse, truth.path_length,
        100.0 * aligned.rmse / truth.path_length, second.trans_rmse, second.rot_rmse_deg,
        metre.trans_rmse, metre.rot_rmse_deg, drift.trans_percent, drift.rot_deg_per_100m)
    assert scores.ate_scale == pytest.approx(1 / 0.3, rel=0.2)
    assert scores.ate_se3_rmse_m > 2.0 * scores.ate_rmse_m


def test_scores_of_a_perfect_estimate_in_another_scale():
    truth = along_x(*range(301))
    scores = asdict(score(along_x(*np.arange(301) / 4.0), truth))
    assert scores.pop('ate_scale') == pytest.approx(4.0)
    assert scores.pop('path_length_m') == 300.0
    assert scores.pop('ate_se3_rmse_m') == pytest.approx(0.75 * np.std(np.arange(301)))
    assert all(value == pytest.approx(0.0, abs=1e-9) for value in scores.values())


def test_what_is_shorter_than_100_m_has_no_drift():
    truth = along_x(*range(30))
    assert undefined(score(truth, truth)) == KITTI


def test_a_prism_has_no_rotation_to_compare():
    prism = Trajectory(along_x(*range(200)).stamps_ns, along_x(*range(200)).poses, False)
    names = undefined(score(along_x(*range(200)), prism))
    assert names == KITTI | {'rpe_trans', 'rpe_rot_deg', 'rpe_trans_per_metre',
                             'rpe_rot_deg_per_metre'}


def test_a_truth_that_stands_still_has_no_scale():
    still = trajectory(np.ones((20, 3)))
    scores = score(trajectory(np.random.default_rng(0).normal(0, 0.1, (20, 3))), still)
    assert set(asdict(scores)) - undefined(scores) == {'ate_se3_rmse_m', 'path_length_m'}
    assert scores.path_length_m == 0.0 and 0.1 < scores.ate_se3_rmse_m < 0.3


def test_steps_longer_than_a_metre_and_a_second_have_no_relative_error():
    truth = trajectory(np.cumsum(np.full((30, 3), 2.0), axis=0), step_ms=1500)
    assert undefined(score(truth, truth)) == {
        'rpe_trans', 'rpe_rot_deg', 'rpe_trans_per_metre', 'rpe_rot_deg_per_metre'}


def test_trivial_estimates_are_scored_like_any_other(data_path):
    stamps_ns, truth = freiburg1_rpy(data_path)
    still, line = (score(make(stamps_ns), truth) for make in (constant_position, straight_line))
    assert undefined(still) == KITTI | {'ate_scale'}
    assert undefined(line) == KITTI
    assert still.ate_rmse_m == still.ate_se3_rmse_m == pytest.approx(0.064, abs=0.0005)
    assert line.ate_rmse_m == pytest.approx(0.049, abs=0.0005)


@pytest.mark.parametrize('estimate, problem', [
    (Trajectory(along_x(0, 1, 2).stamps_ns + 10 ** 12, along_x(0, 1, 2).poses), 'same clock'),
    (along_x(0.0, np.nan, 2.0), 'not finite')])
def test_what_does_not_belong_together_is_refused(estimate, problem):
    with pytest.raises(KfvoError, match=problem):
        score(estimate, along_x(0, 1, 2))
