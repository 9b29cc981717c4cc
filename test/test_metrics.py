# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ATE and RPE against evo and by hand, the trivial estimates, and input that has no answer."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.geometry import Similarity
from kfvo_ros.metrics import (
    absolute_trajectory_error,
    constant_position,
    extent,
    match,
    max_rotation_deg,
    relative_pose_error,
    straight_line,
)
from kfvo_ros.trajectory import Trajectory, parse_stamp_ns, read_kitti_poses, read_tum

EPOCH_NS = 1_403_715_273_262_142_976
MILLISECOND = 1_000_000


def trajectory(positions, step_ms: int = 100, rotation_vectors=None) -> Trajectory:
    """Return poses at regular stamps, not turning unless told."""
    positions = np.asarray(positions, dtype=np.float64)
    turns = np.zeros_like(positions) if rotation_vectors is None else rotation_vectors
    stamps_ns = EPOCH_NS + np.arange(len(positions)) * step_ms * MILLISECOND
    return Trajectory(stamps_ns, geometry.make_transform(geometry.exp_so3(turns), positions))


def along_x(*x: float) -> Trajectory:
    return trajectory([[value, 0.0, 0.0] for value in x])


def wandering(seed: int, count: int = 150) -> Trajectory:
    """Return a random walk in position and rotation that pauses twice."""
    rng = np.random.default_rng(seed)
    steps = geometry.make_transform(geometry.exp_so3(rng.normal(0, 0.1, (count, 3))),
                                    rng.normal(0.2, 0.3, (count, 3)))
    steps[30:40] = steps[100:103] = np.eye(4)
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ step)
    return Trajectory(EPOCH_NS + np.cumsum(rng.integers(30, 70, count)) * MILLISECOND,
                      np.array(poses))


def disturbed(truth: Trajectory, seed: int, trans: float = 0.05, rot: float = 0.02) -> Trajectory:
    """Return the truth with drift, noise and a world and scale of its own."""
    rng = np.random.default_rng(seed)
    count = len(truth)
    drift = np.cumsum(rng.normal(0, trans, (count, 3)), axis=0) / 3
    noise = geometry.make_transform(geometry.exp_so3(rng.normal(0, rot, (count, 3))),
                                    rng.normal(0, trans, (count, 3)) + drift)
    world = Similarity(0.3, geometry.exp_so3([0.5, -1.0, 2.0]), np.array([7.0, 8.0, 9.0]))
    return Trajectory(truth.stamps_ns, world.transform_poses(truth.poses @ noise))


# Against evo


def evo_pair(estimate: Trajectory, truth: Trajectory, with_scale: bool):
    """Return evo's (reference, aligned estimate)."""
    evo = pytest.importorskip('evo.core.trajectory', reason='evo is not installed')
    reference, aligned = (evo.PoseTrajectory3D(poses_se3=list(t.poses.copy()),
                                               timestamps=t.stamps_ns / 1e9)
                          for t in (truth, estimate))
    alignment = aligned.align(reference, correct_scale=with_scale)
    return reference, aligned, alignment


def assert_agrees_with_evo(estimate: Trajectory, truth: Trajectory, with_scale: bool,
                           deltas: list[tuple[float, str]]) -> None:
    """Check ATE, its alignment and every RPE of matched trajectories to 1e-9."""
    reference, aligned, (rotation, translation, scale) = evo_pair(estimate, truth, with_scale)
    from evo.core.metrics import APE, RPE, PoseRelation, Unit
    ape = APE(PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    ours = absolute_trajectory_error(estimate, truth, with_scale)
    assert ours.rmse == pytest.approx(ape.get_all_statistics()['rmse'], rel=0, abs=1e-9)
    np.testing.assert_allclose(ours.errors, ape.error, rtol=0, atol=1e-9)
    assert ours.path_length == pytest.approx(reference.path_length, rel=0, abs=1e-9)
    assert ours.alignment.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(ours.alignment.rotation, rotation, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.alignment.translation, translation, rtol=1e-9, atol=1e-9)
    for delta, unit in deltas:
        relative = relative_pose_error(estimate, truth, delta, unit, with_scale)
        evo_unit = {'frames': Unit.frames, 'metres': Unit.meters}[unit]
        for relation, errors, rmse in (
                (PoseRelation.translation_part, relative.trans, relative.trans_rmse),
                (PoseRelation.rotation_angle_deg, relative.rot_deg, relative.rot_rmse_deg)):
            rpe = RPE(relation, delta, evo_unit, all_pairs=True, pairs_from_reference=True)
            rpe.process_data((reference, aligned))
            np.testing.assert_allclose(errors, rpe.error, rtol=0, atol=1e-9)
            assert rmse == pytest.approx(rpe.get_all_statistics()['rmse'], rel=0, abs=1e-9)


@pytest.mark.parametrize('with_scale', [True, False], ids=['sim3', 'se3'])
@pytest.mark.parametrize('seed', range(5))
def test_random_trajectories_agree_with_evo(seed, with_scale):
    truth = wandering(seed)
    assert_agrees_with_evo(disturbed(truth, seed + 100), truth, with_scale,
                           [(1, 'frames'), (7, 'frames'), (149, 'frames'), (0.6, 'metres'),
                            (2.0, 'metres'), (10.0, 'metres')])


@pytest.mark.parametrize('with_scale', [True, False], ids=['sim3', 'se3'])
def test_a_mirrored_estimate_agrees_with_evo(with_scale):
    truth = wandering(0)
    poses = truth.poses.copy()
    poses[:, 2, 3] *= -1
    mirrored = Trajectory(truth.stamps_ns, poses)
    assert_agrees_with_evo(mirrored, truth, with_scale, [(1, 'frames')])
    assert absolute_trajectory_error(mirrored, truth).rmse > 0.1


def data_file(name: str) -> Path:
    """Return a file of the data folder, or skip the test."""
    root = os.environ.get('KFVO_DATA')
    if not root:
        pytest.skip('KFVO_DATA is not set')
    path = Path(root) / name
    if not path.exists():
        pytest.skip(f'{path} is not there')
    return path


def stamps_of(path: Path) -> np.ndarray:
    lines = path.read_text().splitlines()
    return np.array([parse_stamp_ns(line.split()[0]) for line in lines
                     if not line.startswith('#')])


def freiburg1_rpy() -> tuple[np.ndarray, Trajectory]:
    """Return the stamps of the frames and the ground truth."""
    folder = 'tum/rgbd_dataset_freiburg1_rpy/'
    return stamps_of(data_file(folder + 'rgb.txt')), \
        read_tum(data_file(folder + 'groundtruth.txt'))


@pytest.mark.parametrize('with_scale', [True, False], ids=['sim3', 'se3'])
def test_a_hand_held_camera_agrees_with_evo(with_scale):
    stamps_ns, truth = freiburg1_rpy()
    _, truth = match(constant_position(stamps_ns), truth)
    assert_agrees_with_evo(disturbed(truth, 0, trans=0.003), truth, with_scale,
                           [(1, 'frames'), (30, 'frames'), (0.05, 'metres'), (1.0, 'metres')])


@pytest.mark.parametrize('with_scale', [True, False], ids=['sim3', 'se3'])
def test_a_car_agrees_with_evo(with_scale):
    stamps_ns = stamps_of(data_file('kitti/sequences/03/times.txt'))
    truth = read_kitti_poses(data_file('kitti/poses/03.txt'), stamps_ns)
    assert_agrees_with_evo(disturbed(truth, 1, trans=0.3), truth, with_scale,
                           [(1, 'frames'), (10, 'frames'), (10.0, 'metres'), (100.0, 'metres')])


# By hand


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
    truth = wandering(3)
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
    # The i-th step is seen turned by 2i degrees: chord between 1 and 1.1 at that angle.
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
    # The last pose also serves the two starts that would end 50 and 100 ms later.
    assert len(found.trans) == count - 18


# Matching


def test_match_takes_the_nearest_of_a_faster_truth_in_time_order():
    truth = trajectory(np.arange(300).reshape(100, 3), step_ms=7)
    stamps_ns = EPOCH_NS + np.array([400, 93, 220, 705]) * MILLISECOND
    estimate = constant_position(stamps_ns)
    estimate.poses[:, 0, 3] = [1, 2, 3, 4]
    ours, theirs = match(estimate, truth)
    assert ((ours.stamps_ns - EPOCH_NS) // MILLISECOND).tolist() == [93, 220, 400]
    assert ours.positions[:, 0].tolist() == [2, 3, 1]
    assert ((theirs.stamps_ns - EPOCH_NS) // MILLISECOND).tolist() == [91, 217, 399]
    again = match(ours, theirs)
    np.testing.assert_array_equal(again[1].stamps_ns, theirs.stamps_ns)


@pytest.mark.parametrize('indices, found', [([], 0), ([3], 1), ([3, 4], 2)])
def test_fewer_than_three_matches_are_refused(indices, found):
    truth = wandering(0)
    estimate = truth.select(np.array(indices, dtype=int))
    for evaluate in (match, absolute_trajectory_error):
        with pytest.raises(KfvoError, match=f'found {found} of {found}; estimate .*same clock'):
            evaluate(estimate, truth)
    with pytest.raises(KfvoError, match='truth is empty'):
        match(truth, truth.select(np.zeros(0, dtype=int)))


def test_another_clock_is_named():
    truth = wandering(0)
    late = Trajectory(truth.stamps_ns + 3600 * 10 ** 9, truth.poses)
    with pytest.raises(KfvoError, match=r'found 0 of 150; estimate from 1403718873\.\d{9} to '
                                        r'1403718\d{3}\.\d{9} s, truth from 1403715273\.'):
        match(late, truth)


@pytest.mark.parametrize('which, value', [(0, np.nan), (1, np.inf)])
def test_poses_that_are_not_finite_are_refused(which, value):
    pair = [wandering(0), wandering(0)]
    pair[which].poses[17, 1, 3] = value
    with pytest.raises(KfvoError, match=('the estimate', 'the ground truth')[which]):
        absolute_trajectory_error(*pair)


# Trivial estimates


def test_constant_position_scores_the_spread_of_the_truth():
    truth = wandering(2)
    error = absolute_trajectory_error(constant_position(truth.stamps_ns), truth)
    spread = truth.positions - truth.positions.mean(axis=0)
    assert error.rmse == pytest.approx(np.sqrt(np.mean(np.sum(spread ** 2, axis=1))))
    relative = relative_pose_error(constant_position(truth.stamps_ns), truth, 1, 'frames')
    steps = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    np.testing.assert_allclose(relative.trans, steps, atol=1e-12)


def test_straight_line_scores_the_linear_regression_over_time():
    truth = wandering(2)
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


def test_trivial_estimates_of_freiburg1_rpy():
    stamps_ns, truth = freiburg1_rpy()
    for estimate, metres in ((constant_position, 0.064), (straight_line, 0.049)):
        rmse = absolute_trajectory_error(estimate(stamps_ns), truth).rmse
        assert rmse == pytest.approx(metres, abs=0.0005)


# How much it moved


def test_extent_is_measured_from_the_start():
    assert extent(along_x(5.0, 6.0, 4.0, 5.5)) == 1.0
    assert extent(trajectory([[1, 1, 1], [4, 5, 1], [4, 4, 1]])) == 5.0
    assert extent(along_x(3.0)) == 0.0


def test_rotation_is_measured_from_the_start():
    turns = np.radians([[0, 30.0, 0], [0, 50.0, 0], [0, -60.0, 0], [0, 50.0, 0]])
    assert max_rotation_deg(trajectory(np.zeros((4, 3)), rotation_vectors=turns)) \
        == pytest.approx(90.0)
    assert max_rotation_deg(along_x(0.0, 9.0)) == 0.0


# Without an answer


def test_no_poses_have_not_moved():
    nothing = wandering(0).select(np.zeros(0, dtype=int))
    assert extent(nothing) == max_rotation_deg(nothing) == 0.0
    for estimate in (constant_position, straight_line):
        assert len(estimate(nothing.stamps_ns)) == 0


def test_a_truth_that_never_moves_has_no_scale():
    truth = trajectory(np.tile([0.1, 0.2, 0.3], (10, 1)))
    estimate = Trajectory(truth.stamps_ns, wandering(0).poses[:10])
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
    truth = wandering(4)
    still = Trajectory(truth.stamps_ns, np.tile(truth.poses[70], (len(truth), 1, 1)))
    ours = absolute_trajectory_error(still, truth)
    trivial = absolute_trajectory_error(constant_position(truth.stamps_ns), truth)
    assert ours.rmse == pytest.approx(trivial.rmse)
    assert ours.alignment.scale == 1.0


def test_points_have_an_ate_only():
    poses = wandering(5)
    points = Trajectory(poses.stamps_ns, poses.poses, has_rotation=False)
    assert absolute_trajectory_error(disturbed(poses, 5), points).rmse > 0.0
    for pair in ((poses, points), (points, poses)):
        with pytest.raises(KfvoError, match='without rotation'):
            relative_pose_error(*pair, 1, 'frames')


@pytest.mark.parametrize('delta, unit, problem', [
    (0, 'frames', 'positive'), (-1.0, 'seconds', 'positive'), (np.nan, 'metres', 'positive'),
    (np.inf, 'metres', 'positive'), (1.5, 'frames', 'whole'), (1, 'miles', "'miles' came"),
    (150, 'frames', 'no two of the 150 poses are 150 frames apart, they span 149 frames'),
    (100.0, 'seconds', 'are 100 seconds apart'), (1e-4, 'metres', 'are 0.0001 metres apart'),
    (1e-300, 'metres', 'no two'), (1e-300, 'seconds', 'no two')])
def test_pairs_that_cannot_be_had_are_refused(delta, unit, problem):
    truth = wandering(6)
    with pytest.raises(KfvoError, match=problem):
        relative_pose_error(disturbed(truth, 6), truth, delta, unit)
