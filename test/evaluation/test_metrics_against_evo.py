# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ATE and RPE against evo, the reference implementation."""

from __future__ import annotations

import numpy as np
import pytest
from trajectories import (
    MILLISECOND,
    evo_data,
    evo_kitti,
    freiburg1_rpy,
    perturbed,
    random_walk,
    stamps_of,
)

from kfvo_ros.evaluation.metrics import (
    absolute_trajectory_error,
    associate_trajectories,
    constant_position,
    relative_pose_error,
)
from kfvo_ros.trajectory import Trajectory, read_kitti_poses, read_tum


def evo_pair(estimate: Trajectory, truth: Trajectory, with_scale: bool):
    """Return evo's reference, aligned estimate and alignment."""
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
    truth = random_walk(seed)
    assert_agrees_with_evo(perturbed(truth, seed + 100), truth, with_scale,
                           [(1, 'frames'), (7, 'frames'), (149, 'frames'), (0.6, 'metres'),
                            (2.0, 'metres'), (10.0, 'metres')])


@pytest.mark.parametrize('with_scale', [True, False], ids=['sim3', 'se3'])
def test_a_mirrored_estimate_agrees_with_evo(with_scale):
    truth = random_walk(0)
    poses = truth.poses.copy()
    poses[:, 2, 3] *= -1
    mirrored = Trajectory(truth.stamps_ns, poses)
    assert_agrees_with_evo(mirrored, truth, with_scale, [(1, 'frames')])
    assert absolute_trajectory_error(mirrored, truth).rmse > 0.1


@pytest.mark.parametrize('with_scale', [True, False], ids=['sim3', 'se3'])
def test_a_hand_held_camera_agrees_with_evo(with_scale, data_path):
    stamps_ns, truth = freiburg1_rpy(data_path)
    _, truth = associate_trajectories(constant_position(stamps_ns), truth)
    assert_agrees_with_evo(perturbed(truth, 0, trans=0.003), truth, with_scale,
                           [(1, 'frames'), (30, 'frames'), (0.05, 'metres'), (1.0, 'metres')])


@pytest.mark.parametrize('with_scale', [True, False], ids=['sim3', 'se3'])
def test_a_car_agrees_with_evo(with_scale, data_path):
    stamps_ns = stamps_of(data_path('kitti/sequences/03/times.txt'))
    truth = read_kitti_poses(data_path('kitti/poses/03.txt'), stamps_ns)
    assert_agrees_with_evo(perturbed(truth, 1, trans=0.3), truth, with_scale,
                           [(1, 'frames'), (10, 'frames'), (10.0, 'metres'), (100.0, 'metres')])


@pytest.mark.parametrize('seed', range(2))
def test_seconds_agree_with_evos_frames_at_a_constant_rate(seed):
    truth = random_walk(seed)
    stamps_ns = truth.stamps_ns[0] + np.arange(len(truth)) * 50 * MILLISECOND
    truth = Trajectory(stamps_ns, truth.poses)
    estimate = perturbed(truth, seed + 100)
    # Except for the last starts, which end at the last pose if it is near enough.
    count = len(truth) - 20
    second = relative_pose_error(estimate, truth, 1.0, 'seconds')
    frames = relative_pose_error(estimate, truth, 20, 'frames')
    assert_agrees_with_evo(estimate, truth, True, [(20, 'frames')])
    np.testing.assert_array_equal(second.trans[:count], frames.trans)
    np.testing.assert_array_equal(second.rot_deg[:count], frames.rot_deg)


# Published estimates and their ground truth, from evo's own tests


@pytest.mark.parametrize('with_scale', [True, False], ids=['sim3', 'se3'])
@pytest.mark.parametrize('estimate, truth', [
    ('freiburg1_xyz-rgbdslam', 'freiburg1_xyz-groundtruth'),
    ('freiburg1_xyz-rgbdslam_drift', 'freiburg1_xyz-groundtruth'),
    ('freiburg1_xyz-ORB_kf_mono', 'freiburg1_xyz-groundtruth'),
    ('fr2_desk_ORB', 'fr2_desk_groundtruth'), ('fr2_desk_ORB_kf_mono', 'fr2_desk_groundtruth')])
def test_published_hand_held_estimates_agree_with_evo(estimate, truth, with_scale):
    estimate, truth = associate_trajectories(
        *(read_tum(evo_data(f'{name}.txt')) for name in (estimate, truth)))
    assert_agrees_with_evo(estimate, truth, with_scale,
                           [(1, 'frames'), (10, 'frames'), (0.5, 'metres'), (1.0, 'metres')])


@pytest.mark.parametrize('with_scale', [True, False], ids=['sim3', 'se3'])
@pytest.mark.parametrize('name', ['ORB', 'SPTAM'])
def test_published_estimates_of_a_car_agree_with_evo(name, with_scale):
    assert_agrees_with_evo(evo_kitti(name), evo_kitti('gt'), with_scale,
                           [(1, 'frames'), (10, 'frames'), (1.0, 'metres'), (100.0, 'metres')])


def test_published_estimates_of_a_drone_agree_with_evo():
    files = pytest.importorskip('evo.tools.file_interface', reason='evo is not installed')
    measured = files.read_euroc_csv_trajectory(str(evo_data('V102_groundtruth.csv')))
    stamps_ns = np.rint(measured.timestamps * 1e6).astype(np.int64) * 1000
    truth = Trajectory(stamps_ns, np.array(measured.poses_se3))
    estimate, truth = associate_trajectories(read_tum(evo_data('V102.txt')), truth)
    assert_agrees_with_evo(estimate, truth, True, [(1, 'frames'), (1.0, 'metres')])


@pytest.mark.parametrize('estimate, truth', [
    ('freiburg1_xyz-rgbdslam', 'freiburg1_xyz-groundtruth'),
    ('fr2_desk_ORB', 'fr2_desk_groundtruth')])
def test_association_agrees_with_evo(estimate, truth):
    sync = pytest.importorskip('evo.core.sync', reason='evo is not installed')
    estimate, truth = (read_tum(evo_data(f'{name}.txt')) for name in (estimate, truth))
    ours, theirs = associate_trajectories(estimate, truth), sync.matching_time_indices(
        estimate.stamps_ns / 1e9, truth.stamps_ns / 1e9, max_diff=0.01)
    np.testing.assert_array_equal(ours[0].stamps_ns, estimate.stamps_ns[theirs[0]])
    np.testing.assert_array_equal(ours[1].stamps_ns, truth.stamps_ns[theirs[1]])
