# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ATE, RPE, trivial baselines and amounts of motion by hand."""

from __future__ import annotations

import numpy as np
import pytest
from trajectories import EPOCH_NS, along_x, freiburg1_rpy, random_walk, trajectory

from kfvo_ros import geometry
from kfvo_ros.evaluation.metrics import (
    absolute_trajectory_error,
    constant_position,
    extent,
    max_rotation_deg,
    relative_pose_error,
    straight_line,
)
from kfvo_ros.geometry import Similarity
from kfvo_ros.trajectory import Trajectory


def test_ate_by_hand():
    truth = along_x(0.0, 1.0, 2.0, 3.0)
    estimate = trajectory([[0, 0, 0], [1, 0, 0.4], [2, 0, -0.4], [3, 0, 0]])
    error = absolute_trajectory_error(estimate, truth, with_scale=False)
    # About the means, sum(x x) = 5 and sum(x z) = -0.4: the direction (5, 0, -0.4) becomes x.
    correlation = np.hypot(5.0, 0.4)
    np.testing.assert_allclose(error.alignment.rotation @ [5.0, 0.0, -0.4],
                               [correlation, 0.0, 0.0], atol=1e-12)
    assert error.alignment.scale == 1.0
    assert error.rmse == pytest.approx(np.sqrt((5.0 + 5.32 - 2.0 * correlation) / 4))
    assert error.rmse == pytest.approx(np.sqrt(np.mean(error.errors ** 2)))
    assert error.path_length == 3.0
    np.testing.assert_array_equal(error.stamps_ns, estimate.stamps_ns)
    best_scale = absolute_trajectory_error(estimate, truth)
    assert best_scale.alignment.scale == pytest.approx(correlation / 5.32)
    assert best_scale.rmse == pytest.approx(np.sqrt((5.0 - correlation ** 2 / 5.32) / 4))


def test_ate_is_zero_in_another_world():
    truth = random_walk(3)
    world = Similarity(20.0, geometry.exp_so3([1.0, 2.0, 0.5]), np.array([1.0, 2.0, 3.0]))
    estimate = Trajectory(truth.stamps_ns, world.transform_poses(truth.poses))
    error = absolute_trajectory_error(estimate, truth)
    assert error.rmse < 1e-12
    assert error.alignment.scale == pytest.approx(1 / 20.0)
    np.testing.assert_allclose(error.alignment.transform_poses(estimate.poses), truth.poses,
                               atol=1e-11)
    relative = relative_pose_error(estimate, truth, 5, 'frames')
    assert relative.trans_rmse < 1e-12 and relative.rot_rmse_deg < 1e-9
    assert relative_pose_error(estimate, truth, 5, 'frames', with_scale=False).trans_rmse > 1.0


def test_rpe_by_hand():
    truth = along_x(*range(6))
    turns = np.radians([[0, 0, 2.0 * i] for i in range(6)])
    estimate = trajectory([[1.1 * i, 0, 0] for i in range(6)], rotation_vectors=turns)
    one = relative_pose_error(estimate, truth, 1, 'frames', with_scale=False)
    np.testing.assert_allclose(one.rot_deg, [2.0] * 5)
    # The i-th step is rotated by 2i degrees: the chord between 1 and 1.1 at that angle.
    expected = [np.hypot(1.1 * np.cos(a) - 1, 1.1 * np.sin(a)) for a in turns[:5, 2]]
    np.testing.assert_allclose(one.trans, expected)
    assert one.trans_rmse == pytest.approx(np.sqrt(np.mean(np.square(expected))))
    np.testing.assert_array_equal(one.stamps_ns, truth.stamps_ns[:5])
    scaled = relative_pose_error(estimate, truth, 1, 'frames')
    assert scaled.trans[0] == pytest.approx(0.0, abs=1e-12)
    three = relative_pose_error(estimate, truth, 3.0, 'frames')
    np.testing.assert_allclose(three.rot_deg, [6.0] * 3)


@pytest.mark.parametrize('delta, unit, pairs', [
    (1, 'frames', {(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)}),
    (5, 'frames', {(0, 5)}),
    (0.2, 'seconds', {(0, 2), (1, 3), (2, 4), (3, 5)}),
    (0.205, 'seconds', {(0, 2), (1, 3), (2, 4), (3, 5)}),
    (1.0, 'metres', {(0, 1), (1, 4), (2, 4), (3, 4), (4, 5)}),
    (2.0, 'metres', {(0, 4), (1, 5), (2, 5), (3, 5)}),
    (2.15, 'metres', {(0, 4), (1, 5), (2, 5), (3, 5)}),
    (3.3, 'metres', {(0, 5)})])
def test_pairs_are_the_nearest_within_a_tenth(delta, unit, pairs):
    truth = along_x(0.0, 1.0, 1.0, 1.0, 2.0, 3.0)
    marks = np.array([0.0, 1.0, 3.0, 7.0, 12.0, 20.0])
    assert len({b - a for a in marks for b in marks if b > a}) == 15
    turns = np.radians(np.column_stack([marks, np.zeros(6), np.zeros(6)]))
    estimate = trajectory(truth.positions, rotation_vectors=turns)
    found = relative_pose_error(estimate, truth, delta, unit)
    np.testing.assert_allclose(np.sort(found.rot_deg), sorted(marks[b] - marks[a]
                                                              for a, b in pairs))


def test_jittering_stamps_do_not_change_the_pairs():
    count, jitter = 60, np.random.default_rng(0).integers(-128, 128, 60)
    regular = trajectory(np.arange(3 * count).reshape(count, 3) ** 1.5, step_ms=50)
    jittered = Trajectory(regular.stamps_ns + jitter, regular.poses)
    found = relative_pose_error(constant_position(jittered.stamps_ns), jittered, 1.0, 'seconds')
    expected = relative_pose_error(constant_position(regular.stamps_ns), regular, 20, 'frames')
    np.testing.assert_array_equal(found.trans[:count - 20], expected.trans)
    # The last pose also ends the pairs of two starts that would end 50 and 100 ms later.
    assert len(found.trans) == count - 18


# Trivial baselines


def test_constant_position_scores_the_spread_of_the_truth():
    truth = random_walk(2)
    error = absolute_trajectory_error(constant_position(truth.stamps_ns), truth)
    spread = truth.positions - truth.positions.mean(axis=0)
    assert error.rmse == pytest.approx(np.sqrt(np.mean(np.sum(spread ** 2, axis=1))))
    relative = relative_pose_error(constant_position(truth.stamps_ns), truth, 1, 'frames')
    steps = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    np.testing.assert_allclose(relative.trans, steps, atol=1e-12)


def test_straight_line_scores_the_linear_regression_over_time():
    truth = random_walk(2)
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9
    basis = np.column_stack([seconds, np.ones(len(truth))])
    residual = truth.positions - basis @ np.linalg.lstsq(basis, truth.positions, rcond=None)[0]
    error = absolute_trajectory_error(straight_line(truth.stamps_ns), truth)
    assert error.rmse == pytest.approx(np.sqrt(np.mean(np.sum(residual ** 2, axis=1))))
    assert error.rmse < absolute_trajectory_error(constant_position(truth.stamps_ns), truth).rmse


def test_straight_line_fits_constant_speed_at_irregular_stamps():
    stamps_ns = EPOCH_NS + np.array([0, 1, 5, 6, 20]) * 10 ** 8
    assert straight_line(stamps_ns).positions[:, 0].tolist() == [0.0, 0.1, 0.5, 0.6, 2.0]
    truth = trajectory(np.zeros((5, 3)))
    truth = Trajectory(stamps_ns, truth.poses)
    truth.poses[:, :3, 3] = np.outer([0, 1, 5, 6, 20], [3.0, -4.0, 5.0]) + [9, 8, 7]
    assert absolute_trajectory_error(straight_line(stamps_ns), truth).rmse < 1e-12


def test_trivial_baselines_of_freiburg1_rpy(data_path):
    stamps_ns, truth = freiburg1_rpy(data_path)
    for estimate, metres in ((constant_position, 0.064), (straight_line, 0.049)):
        rmse = absolute_trajectory_error(estimate(stamps_ns), truth).rmse
        assert rmse == pytest.approx(metres, abs=0.0005)


# Amounts of motion


def test_extent_is_measured_from_the_start():
    assert extent(along_x(5.0, 6.0, 4.0, 5.5)) == 1.0
    assert extent(trajectory([[1, 1, 1], [4, 5, 1], [4, 4, 1]])) == 5.0
    assert extent(along_x(3.0)) == 0.0


def test_rotation_is_measured_from_the_start():
    turns = np.radians([[0, 30.0, 0], [0, 50.0, 0], [0, -60.0, 0], [0, 50.0, 0]])
    assert max_rotation_deg(trajectory(np.zeros((4, 3)), rotation_vectors=turns)) \
        == pytest.approx(90.0)
    assert max_rotation_deg(along_x(0.0, 9.0)) == 0.0
