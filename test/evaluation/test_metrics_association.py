# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Association of poses, and trajectories without a defined error."""

from __future__ import annotations

import numpy as np
import pytest
from trajectories import EPOCH_NS, MILLISECOND, perturbed, random_walk, trajectory

from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation.metrics import (
    absolute_trajectory_error,
    associate_trajectories,
    constant_position,
    extent,
    max_rotation_deg,
    relative_pose_error,
    straight_line,
)
from kfvo_ros.trajectory import Trajectory


def test_association_takes_the_nearest_stamps_in_time_order():
    truth = trajectory(np.arange(300).reshape(100, 3), step_ms=7)
    stamps_ns = EPOCH_NS + np.array([400, 93, 220, 705]) * MILLISECOND
    estimate = constant_position(stamps_ns)
    estimate.poses[:, 0, 3] = [1, 2, 3, 4]
    ours, theirs = associate_trajectories(estimate, truth)
    assert ((ours.stamps_ns - EPOCH_NS) // MILLISECOND).tolist() == [93, 220, 400]
    assert ours.positions[:, 0].tolist() == [2, 3, 1]
    assert ((theirs.stamps_ns - EPOCH_NS) // MILLISECOND).tolist() == [91, 217, 399]
    again = associate_trajectories(ours, theirs)
    np.testing.assert_array_equal(again[1].stamps_ns, theirs.stamps_ns)


@pytest.mark.parametrize('indices, found', [([], 0), ([3], 1), ([3, 4], 2)])
def test_fewer_than_three_matches_are_rejected(indices, found):
    truth = random_walk(0)
    estimate = truth.select(np.array(indices, dtype=int))
    for evaluate in (associate_trajectories, absolute_trajectory_error):
        with pytest.raises(KfvoError, match=f'found {found} of {found}; estimate .*same clock'):
            evaluate(estimate, truth)
    with pytest.raises(KfvoError, match='truth is empty'):
        associate_trajectories(truth, truth.select(np.zeros(0, dtype=int)))


def test_the_error_of_different_clocks_names_both_time_spans():
    truth = random_walk(0)
    late = Trajectory(truth.stamps_ns + 3600 * 10 ** 9, truth.poses)
    with pytest.raises(KfvoError, match=r'found 0 of 150; estimate from 1403718873\.\d{9} to '
                                        r'1403718\d{3}\.\d{9} s, truth from 1403715273\.'):
        associate_trajectories(late, truth)


@pytest.mark.parametrize('which, value', [(0, np.nan), (1, np.inf)])
def test_poses_that_are_not_finite_are_rejected(which, value):
    pair = [random_walk(0), random_walk(0)]
    pair[which].poses[17, 1, 3] = value
    with pytest.raises(KfvoError, match=('the estimate', 'the ground truth')[which]):
        absolute_trajectory_error(*pair)


# Undefined errors


def test_an_empty_trajectory_has_no_motion():
    nothing = random_walk(0).select(np.zeros(0, dtype=int))
    assert extent(nothing) == max_rotation_deg(nothing) == 0.0
    for estimate in (constant_position, straight_line):
        assert len(estimate(nothing.stamps_ns)) == 0


def test_a_truth_that_never_moves_has_no_scale():
    truth = trajectory(np.tile([0.1, 0.2, 0.3], (10, 1)))
    estimate = Trajectory(truth.stamps_ns, random_walk(0).poses[:10])
    for with_scale in (lambda: absolute_trajectory_error(estimate, truth),
                       lambda: relative_pose_error(estimate, truth, 1, 'frames')):
        with pytest.raises(KfvoError, match='never moves'):
            with_scale()
    error = absolute_trajectory_error(estimate, truth, with_scale=False)
    spread = estimate.positions - estimate.positions.mean(axis=0)
    assert error.rmse == pytest.approx(np.sqrt(np.mean(np.sum(spread ** 2, axis=1))))
    assert np.isfinite(relative_pose_error(estimate, truth, 1, 'frames', False).trans_rmse)
    with pytest.raises(KfvoError, match='no two of the 10 poses are 1 metres apart'):
        relative_pose_error(estimate, truth, 1, 'metres', with_scale=False)


def test_an_estimate_that_never_moves_scores_as_constant_position():
    truth = random_walk(4)
    still = Trajectory(truth.stamps_ns, np.tile(truth.poses[70], (len(truth), 1, 1)))
    ours = absolute_trajectory_error(still, truth)
    trivial = absolute_trajectory_error(constant_position(truth.stamps_ns), truth)
    assert ours.rmse == pytest.approx(trivial.rmse)
    assert ours.alignment.scale == 1.0


def test_positions_without_rotation_have_an_ate_only():
    poses = random_walk(5)
    points = Trajectory(poses.stamps_ns, poses.poses, has_rotation=False)
    assert absolute_trajectory_error(perturbed(poses, 5), points).rmse > 0.0
    for pair in ((poses, points), (points, poses)):
        with pytest.raises(KfvoError, match='without rotation'):
            relative_pose_error(*pair, 1, 'frames')


@pytest.mark.parametrize('delta, unit, problem', [
    (0, 'frames', 'positive'), (-1.0, 'seconds', 'positive'), (np.nan, 'metres', 'positive'),
    (np.inf, 'metres', 'positive'), (1.5, 'frames', 'whole'), (1, 'miles', "'miles' came"),
    (150, 'frames', 'no two of the 150 poses are 150 frames apart, they span 149 frames'),
    (100.0, 'seconds', 'are 100 seconds apart'), (1e-4, 'metres', 'are 0.0001 metres apart'),
    (1e-300, 'metres', 'no two'), (1e-300, 'seconds', 'no two')])
def test_impossible_pairs_are_rejected(delta, unit, problem):
    truth = random_walk(6)
    with pytest.raises(KfvoError, match=problem):
        relative_pose_error(perturbed(truth, 6), truth, delta, unit)
