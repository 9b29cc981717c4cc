# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The method on rendered images: windows, keyframes, finality, reproducibility."""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np
import pytest
from odometry_scenes import PATTERN, OdometryRun, ScriptedPolicy, frames_of, run, truth_of

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.evaluation import metrics
from kfvo_ros.keyframes.heuristics import EveryFrame, OpticalFlow, Survival
from kfvo_ros.odometry.keyframe_odometry import WINDOW_SIZE, KeyframeOdometry
from kfvo_ros.sequences.base import Frame

COUNT = 60


@pytest.fixture(scope='module')
def frames() -> tuple[Frame, ...]:
    return frames_of(0, COUNT)


@pytest.fixture(scope='module')
def survival(frames) -> OdometryRun:
    return run(frames)


@pytest.fixture(scope='module')
def scripted(frames) -> OdometryRun:
    return run(frames, ScriptedPolicy(*PATTERN * 12))


def test_every_frame_has_one_pose_in_input_order(frames, survival, scripted):
    for result in (survival, scripted, run(frames[:20], EveryFrame())):
        stamps = [update.stamp_ns for update in result.updates]
        assert [frame_pose.stamp_ns for frame_pose in result.final] == stamps
        assert stamps == [frame.stamp_ns for frame in frames[:len(stamps)]]


def test_the_first_camera_is_the_world(survival):
    assert np.array_equal(survival.updates[0].T_world_camera, np.eye(4))
    assert np.array_equal(survival.final[0].T_world_camera, np.eye(4))


def test_trajectory_is_close_to_the_truth(frames, survival):
    truth = truth_of(0, COUNT)
    error = metrics.absolute_trajectory_error(survival.trajectory, truth)
    assert error.rmse < 0.01 * error.path_length
    relative = metrics.relative_pose_error(survival.trajectory, truth, 10, 'frames')
    assert relative.rot_rmse_deg < 0.8  # [deg] over 10 frames at 320x240
    assert set(survival.statuses) == {'ok'}


def test_rotations_are_orthonormalised(frames):
    """Errors of rotations, as of many products, are removed at the next keyframe."""
    odometry = KeyframeOdometry(GeometricBackbone(), EveryFrame())
    for frame in frames[:12]:
        odometry.process(frame)
    for keyframe in odometry.window:
        keyframe.T_world_camera = keyframe.T_world_camera * (1.0 + 1e-7)
    before, after = (odometry.process(frame).T_world_camera[:3, :3] for frame in frames[12:14])
    assert np.abs(before @ before.T - np.eye(3)).max() > 1e-8
    assert np.abs(after @ after.T - np.eye(3)).max() < 1e-14


def test_first_seven_are_keyframes_and_then_the_policy_decides(scripted):
    kept = [update.is_keyframe for update in scripted.updates]
    assert kept[:WINDOW_SIZE - 1] == [True] * (WINDOW_SIZE - 1)
    expected = list(itertools.islice(itertools.cycle(PATTERN), COUNT - WINDOW_SIZE + 1))
    assert kept[WINDOW_SIZE - 1:] == expected
    assert [frame_pose.is_keyframe for frame_pose in scripted.final] == kept


def test_policy_observes_the_whole_window(frames):
    policy, backbone = ScriptedPolicy(True, False), GeometricBackbone()
    run(frames[:14], policy, backbone)
    assert len(policy.inputs) == 14 - (WINDOW_SIZE - 1)
    assert [decision.gap for decision in policy.inputs] == [1, 1, 2, 3, 4, 5, 6]
    size = backbone.descriptor_size + 7 * (WINDOW_SIZE - 1) + len(backbone.signal_names)
    for decision in policy.inputs:
        assert decision.observation.shape == (size,)
        assert decision.observation.dtype == np.float32
        assert np.isfinite(decision.observation).all()


@pytest.mark.parametrize(('size', 'count'), [(8, 20), (4, 12)])
def test_window_grows_to_its_size_and_no_further(frames, size, count):
    odometry = KeyframeOdometry(GeometricBackbone(), ScriptedPolicy(*PATTERN * 12), None, size)
    sizes = []
    for frame in frames[:count]:
        window = odometry.encode(frame)
        estimate = None
        if window is not None:
            sizes.append(len(window.frames))
            assert window.frames[-1].stamp_ns == frame.stamp_ns
            estimate = odometry.backbone.estimate([window])[0]
        step = odometry.integrate(estimate)
        odometry.commit(step.keep if step.decision is None
                        else odometry.policy.decide(step.decision), {})
    assert sizes == [min(n, size) for n in range(2, count + 1)]


def test_final_poses_never_change(survival, scripted):
    for result in (survival, scripted):
        assert len(result.emitted_poses) == COUNT
        for pose, frame_pose in zip(result.emitted_poses, result.final):
            assert pose.tobytes() == frame_pose.T_world_camera.tobytes()


def test_poses_become_final_when_their_keyframe_leaves_the_window(scripted):
    kept = [update.is_keyframe for update in scripted.updates]
    keyframe_of = np.cumsum(kept) - 1
    final = 0
    for index, update in enumerate(scripted.updates):
        final += len(update.final)
        left = max(sum(kept[:index + 1]) - (WINDOW_SIZE - 1), 0)
        assert final == int((keyframe_of[:index + 1] < left).sum())
    assert final < COUNT


def test_dropped_frame_follows_its_keyframe(frames):
    odometry = KeyframeOdometry(GeometricBackbone(), ScriptedPolicy(True, True, False, True))
    for frame in frames[:10]:
        update = odometry.process(frame)
    keyframe, dropped = odometry.pending[-2:]
    assert (keyframe.is_keyframe, dropped.is_keyframe) == (True, False)
    np.testing.assert_allclose(dropped.T_world_camera, update.T_world_camera, atol=1e-12)
    before = keyframe.T_world_camera.copy(), dropped.T_world_camera.copy()
    for frame in frames[10:14]:
        odometry.process(frame)
    after = keyframe.T_world_camera, dropped.T_world_camera
    assert not np.allclose(before[0], after[0], atol=1e-7)  # refined since
    np.testing.assert_allclose(geometry.relative(*before), geometry.relative(*after), atol=1e-12)


def test_the_single_steps_equal_process(frames, survival):
    odometry = KeyframeOdometry(GeometricBackbone(), Survival())
    for frame, expected in zip(frames[:25], survival.updates):
        window = odometry.encode(frame)
        estimate = odometry.backbone.estimate([window])[0] if window else None
        step = odometry.integrate(estimate)
        keep = step.keep if step.decision is None else odometry.policy.decide(step.decision)
        update = odometry.commit(keep, {})
        assert update.T_world_camera.tobytes() == expected.T_world_camera.tobytes()
        assert update.covariance.tobytes() == expected.covariance.tobytes()
        assert update.is_keyframe == expected.is_keyframe


def test_same_seed_same_bytes(frames, survival):
    def arrivals(result: OdometryRun) -> bytes:
        return np.stack([update.T_world_camera for update in result.updates[:30]]).tobytes()

    assert arrivals(run(frames[:30])) == arrivals(survival)
    assert arrivals(run(frames[:30], backbone=GeometricBackbone(3))) != arrivals(survival)


def test_two_odometries_batched_on_one_backbone_equal_separate_runs(frames, survival):
    others = frames_of(1, COUNT)
    backbone = GeometricBackbone()
    odometries = [KeyframeOdometry(backbone, Survival()) for _ in range(2)]
    poses: list[list[np.ndarray]] = [[], []]
    for pair in zip(frames[:25], others):
        windows = [odometry.encode(frame) for odometry, frame in zip(odometries, pair)]
        estimates = backbone.estimate(windows) if all(windows) else [None, None]
        for odometry, estimate, estimated in zip(odometries, estimates, poses):
            step = odometry.integrate(estimate)
            keep = step.keep if step.decision is None else odometry.policy.decide(step.decision)
            estimated.append(odometry.commit(keep, {}).T_world_camera)
    alone = [survival, run(others[:25])]
    for estimated, result in zip(poses, alone):
        expected = [update.T_world_camera for update in result.updates[:25]]
        assert np.stack(estimated).tobytes() == np.stack(expected).tobytes()


@pytest.mark.parametrize('rule', ['none', 'translation', 'depth'])
def test_every_scale_rule_tracks(frames, rule):
    result = run(frames[:40], scale_rule=rule)
    error = metrics.absolute_trajectory_error(result.trajectory, truth_of(0, COUNT))
    assert error.rmse < 0.03 * error.path_length


@pytest.mark.parametrize('policy', [EveryFrame, partial(OpticalFlow, 25.0), Survival])
def test_policies_choose_keyframes(frames, policy):
    result = run(frames[:40], policy())
    assert np.isfinite(result.poses).all()
    keyframes = sum(update.is_keyframe for update in result.updates)
    assert keyframes == 40 if policy is EveryFrame else WINDOW_SIZE <= keyframes < 35


def test_update_has_covariance_depth_and_durations(survival):
    for update in survival.updates[1:]:
        assert set(update.durations) == {'encode', 'estimate', 'decide'}
        assert min(update.durations.values()) >= 0.0
        assert np.isfinite(update.covariance).all()
        values = np.linalg.eigvalsh(update.covariance)
        assert values.min() >= -1e-9 * values.max()
    depths = np.array([update.median_depth for update in survival.updates[1:]])
    assert (np.abs(np.log(depths)) < 1.5).all()  # the first window's median depth is 1
    assert survival.updates[0].median_depth is None


def test_with_covariance_changes_nothing_else(frames, survival):
    plain = run(frames[:20], with_covariance=False)
    for update, expected in zip(plain.updates, survival.updates, strict=False):
        assert update.T_world_camera.tobytes() == expected.T_world_camera.tobytes()
        assert update.is_keyframe == expected.is_keyframe
        assert not update.covariance.any() and not update.window_covariance.any()
    assert survival.updates[19].covariance.any()


def test_finish_returns_each_frame_once(frames):
    odometry = KeyframeOdometry(GeometricBackbone(), Survival())
    early = [frame_pose for frame in frames[:9] for frame_pose in odometry.process(frame).final]
    assert len(early) + len(odometry.pending) == 9
    assert len(early) + len(odometry.finish()) == 9
    assert odometry.finish() == ()
    assert KeyframeOdometry(GeometricBackbone(), Survival()).finish() == ()
