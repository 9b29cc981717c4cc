# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The method on rendered images: windows, keyframes, finality, reproducibility, memory."""

from __future__ import annotations

import gc
import itertools
from types import ModuleType

import numpy as np
import pytest
from odometry_scenes import RATE_NS, Run, Scripted, frames_of, restamped, run, truth_of

from kfvo_ros import geometry, metrics
from kfvo_ros.backbones.base import Backbone, Encoded
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.observations import View
from kfvo_ros.keyframes.heuristics import Every, OpticalFlow, Survival
from kfvo_ros.odometry import WINDOW_SIZE, KeyframeOdometry
from kfvo_ros.sequences.base import Frame

COUNT = 60
PATTERN = [True, False, False, True, False]


@pytest.fixture(scope='module')
def frames() -> tuple[Frame, ...]:
    return frames_of(0, COUNT)


@pytest.fixture(scope='module')
def survival(frames) -> Run:
    return run(frames)


@pytest.fixture(scope='module')
def scripted(frames) -> Run:
    return run(frames, Scripted(*PATTERN * 12))


def test_every_frame_gets_one_pose_in_input_order(frames, survival, scripted):
    for result in (survival, scripted, run(frames[:20], Every())):
        stamps = [update.stamp_ns for update in result.updates]
        assert [placed.stamp_ns for placed in result.placed] == stamps
        assert stamps == [frame.stamp_ns for frame in frames[:len(stamps)]]


def test_the_world_is_the_first_camera(survival):
    assert np.array_equal(survival.updates[0].T_world_camera, np.eye(4))
    assert np.array_equal(survival.placed[0].T_world_camera, np.eye(4))


def test_trajectory_follows_the_truth(frames, survival):
    truth = truth_of(0, COUNT)
    error = metrics.absolute_trajectory_error(survival.trajectory, truth)
    assert error.rmse < 0.01 * error.path_length
    turned = metrics.relative_pose_error(survival.trajectory, truth, 10, 'frames')
    assert turned.rot_rmse_deg < 0.8  # [deg] over 10 frames at 320x240
    assert set(survival.statuses) == {'ok'}


def test_first_seven_are_keyframes_and_then_the_policy_decides(scripted):
    kept = [update.is_keyframe for update in scripted.updates]
    assert kept[:WINDOW_SIZE - 1] == [True] * (WINDOW_SIZE - 1)
    expected = list(itertools.islice(itertools.cycle(PATTERN), COUNT - WINDOW_SIZE + 1))
    assert kept[WINDOW_SIZE - 1:] == expected
    assert [placed.is_keyframe for placed in scripted.placed] == kept


def test_policy_sees_the_whole_window(frames):
    policy, backbone = Scripted(True, False), GeometricBackbone()
    run(frames[:14], policy, backbone)
    assert len(policy.seen) == 14 - (WINDOW_SIZE - 1)
    assert [decision.gap for decision in policy.seen] == [1, 1, 2, 3, 4, 5, 6]
    size = backbone.descriptor_size + 7 * (WINDOW_SIZE - 1) + len(backbone.signal_names)
    for decision in policy.seen:
        assert decision.observation.shape == (size,)
        assert decision.observation.dtype == np.float32
        assert np.isfinite(decision.observation).all()


@pytest.mark.parametrize(('size', 'count'), [(8, 20), (4, 12)])
def test_window_grows_to_its_size_and_no_further(frames, size, count):
    odometry = KeyframeOdometry(GeometricBackbone(), Scripted(*PATTERN * 12), None, size)
    sizes = []
    for frame in frames[:count]:
        window = odometry.begin(frame)
        estimate = None
        if window is not None:
            sizes.append(len(window.frames))
            assert window.frames[-1].stamp_ns == frame.stamp_ns
            estimate = odometry.backbone.estimate([window])[0]
        decision = odometry.integrate(estimate)
        odometry.commit(decision if isinstance(decision, bool)
                        else odometry.policy.decide(decision), {})
    assert sizes == [min(n, size) for n in range(2, count + 1)]


def test_final_poses_never_change(survival, scripted):
    for result in (survival, scripted):
        assert len(result.handed_out) == COUNT
        for pose, placed in zip(result.handed_out, result.placed):
            assert pose.tobytes() == placed.T_world_camera.tobytes()


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
    odometry = KeyframeOdometry(GeometricBackbone(), Scripted(True, True, False, True))
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


def test_steps_one_by_one_are_process(frames, survival):
    odometry = KeyframeOdometry(GeometricBackbone(), Survival())
    for frame, expected in zip(frames[:25], survival.updates):
        window = odometry.begin(frame)
        estimate = odometry.backbone.estimate([window])[0] if window else None
        decision = odometry.integrate(estimate)
        keep = decision if isinstance(decision, bool) else odometry.policy.decide(decision)
        update = odometry.commit(keep, {})
        assert update.T_world_camera.tobytes() == expected.T_world_camera.tobytes()
        assert update.covariance.tobytes() == expected.covariance.tobytes()
        assert update.is_keyframe == expected.is_keyframe


def test_same_seed_same_bytes(frames, survival):
    def arrivals(result: Run) -> bytes:
        return np.stack([update.T_world_camera for update in result.updates[:30]]).tobytes()

    assert arrivals(run(frames[:30])) == arrivals(survival)
    assert arrivals(run(frames[:30], backbone=GeometricBackbone(3))) != arrivals(survival)


def test_two_odometries_batched_on_one_backbone_equal_two_runs(frames, survival):
    others = frames_of(1, COUNT)
    backbone = GeometricBackbone()
    odometries = [KeyframeOdometry(backbone, Survival()) for _ in range(2)]
    poses: list[list[np.ndarray]] = [[], []]
    for pair in zip(frames[:25], others):
        windows = [odometry.begin(frame) for odometry, frame in zip(odometries, pair)]
        estimates = backbone.estimate(windows) if all(windows) else [None, None]
        for odometry, estimate, taken in zip(odometries, estimates, poses):
            decision = odometry.integrate(estimate)
            keep = decision if isinstance(decision, bool) else odometry.policy.decide(decision)
            taken.append(odometry.commit(keep, {}).T_world_camera)
    alone = [survival, run(others[:25])]
    for taken, result in zip(poses, alone):
        expected = [update.T_world_camera for update in result.updates[:25]]
        assert np.stack(taken).tobytes() == np.stack(expected).tobytes()


@pytest.mark.parametrize('rule', ['none', 'translation', 'depth'])
def test_every_scale_rule_gives_a_trajectory(frames, rule):
    result = run(frames[:40], scale_rule=rule)
    error = metrics.absolute_trajectory_error(result.trajectory, truth_of(0, COUNT))
    assert error.rmse < 0.03 * error.path_length


@pytest.mark.parametrize('policy', [Every(), OpticalFlow(25.0), Survival()])
def test_policies_share_the_tracks(frames, policy):
    result = run(frames[:40], policy)
    assert np.isfinite(result.poses).all()
    keyframes = sum(update.is_keyframe for update in result.updates)
    assert keyframes == 40 if isinstance(policy, Every) else WINDOW_SIZE <= keyframes < 35


def test_update_tells_covariance_depth_and_durations(survival):
    for update in survival.updates[1:]:
        assert set(update.durations) == {'encode', 'estimate', 'decide'}
        assert min(update.durations.values()) >= 0.0
        assert np.isfinite(update.covariance).all()
        values = np.linalg.eigvalsh(update.covariance)
        assert values.min() >= -1e-9 * values.max()
    depths = np.array([update.median_depth for update in survival.updates[1:]])
    assert (np.abs(np.log(depths)) < 1.5).all()  # the first window's median depth is 1
    assert survival.updates[0].median_depth is None


class Forgetful(Backbone):
    """A backbone without points, tracks or memory: it sees the world's pose in the stamp."""

    name = 'forgetful'
    descriptor_size = 1

    def __init__(self, unit: float) -> None:
        self.unit = unit
        self.released: list[int] = []
        self.opened = 0

    def open(self, camera):
        from kfvo_ros.backbones.base import Stream
        backbone = self
        self.opened += 1

        class Plain(Stream):
            def encode(self, frame):
                return Encoded(frame.stamp_ns, np.ones(1, dtype=np.float32))

            def release(self, encoded):
                backbone.released.append(encoded.stamp_ns)
        return Plain()

    def estimate(self, windows):
        from kfvo_ros.backbones.base import Estimate
        result = []
        for window in windows:
            world = np.stack([self.pose(frame.stamp_ns) for frame in window.frames])
            poses = geometry.relative(world[0], world)
            poses[:, :3, 3] /= self.unit * (1.0 + 0.5 * np.sin(window.frames[0].stamp_ns))
            poses[0] = np.eye(4)
            result.append(Estimate(poses, np.zeros((len(poses), 6, 6)), None,
                                   np.zeros(0, dtype=np.float32), memory='anything'))
        return result

    @staticmethod
    def pose(stamp_ns: int) -> np.ndarray:
        along = stamp_ns / RATE_NS - 1.0
        return geometry.make_transform(geometry.exp_so3(np.array([0.0, 0.02, 0.01]) * along),
                                       [along, np.sin(0.3 * along), 0.2 * along])


def test_a_backbone_without_points_or_tracks(frames):
    """VGGT's way: every window in a unit of its own, the tracker only for the policy."""
    backbone = Forgetful(3.0)
    given = restamped([frame.image for frame in frames[:40]], frames[0].camera)
    result = run(given, Survival(), backbone)
    truth = np.stack([Forgetful.pose(frame.stamp_ns) for frame in given])
    fit = geometry.umeyama(result.poses[:, :3, 3], truth[:, :3, 3])
    np.testing.assert_allclose(fit.transform_points(result.poses[:, :3, 3]), truth[:, :3, 3],
                               atol=1e-6)
    assert backbone.opened == 1
    assert all(update.median_depth is None for update in result.updates)
    # What left the window was released, once; what is still in it was not.
    dropped = [update.stamp_ns for update in result.updates if not update.is_keyframe]
    kept = [update.stamp_ns for update in result.updates if update.is_keyframe]
    assert 0 < len(dropped) < 33
    assert sorted(backbone.released) == sorted(dropped + kept[:-(WINDOW_SIZE - 1)])


def test_scale_rule_none_trusts_the_window(frames):
    given = restamped([frame.image for frame in frames[:20]], frames[0].camera)
    trusting = run(given, Every(), Forgetful(3.0), scale_rule='none')
    aligned = run(given, Every(), Forgetful(3.0))
    truth = np.stack([Forgetful.pose(frame.stamp_ns) for frame in given])[:, :3, 3]

    def misfit(result):
        positions = result.poses[:, :3, 3]
        fitted = geometry.umeyama(positions, truth).transform_points(positions)
        return np.abs(fitted - truth).max()

    assert misfit(aligned) < 1e-6 < 0.1 < misfit(trusting)


def to_and_fro(frames: tuple[Frame, ...]) -> itertools.chain:
    """Return the images there and back again, for ever."""
    there = [frame.image for frame in frames]
    return itertools.cycle(there + there[-2:0:-1])


def bytes_held(root: object) -> int:
    """Return the size of all arrays that can be reached from an object."""
    seen, queue, total = {id(root)}, [root], 0
    while queue:
        thing = queue.pop()
        total += thing.nbytes if isinstance(thing, np.ndarray) else 0
        for referent in gc.get_referents(thing):
            if id(referent) not in seen and not isinstance(referent, type | ModuleType):
                seen.add(id(referent))
                queue.append(referent)
    return total


def test_memory_does_not_grow_with_the_sequence():
    frames = frames_of(2, 30, width=160, height=120)
    policy = Scripted(*PATTERN * 60)
    odometry = KeyframeOdometry(GeometricBackbone(), policy)
    held, views, pending = [], [], []
    for index, image in enumerate(itertools.islice(to_and_fro(frames), 300)):
        odometry.process(Frame((index + 1) * RATE_NS, image, frames[0].camera))
        policy.seen.clear()
        if index % 20 == 19:
            gc.collect()
            held.append(bytes_held(odometry))
            views.append(sum(isinstance(thing, View) for thing in gc.get_objects()))
            pending.append(len(odometry.pending))
    assert min(held) > 50_000  # the images and tracks of a window at least
    assert max(held[5:]) <= 1.5 * max(held[:5])
    assert max(views[5:]) <= max(views[:5]) + WINDOW_SIZE
    assert max(pending) <= 3 * WINDOW_SIZE


def test_pending_frames_are_bounded_while_keyframes_come(frames):
    odometry = KeyframeOdometry(GeometricBackbone(), Scripted(*PATTERN * 12))
    longest = 0
    for frame in frames:
        odometry.process(frame)
        longest = max(longest, len(odometry.pending))
    assert WINDOW_SIZE - 1 < longest <= 3 * WINDOW_SIZE


def test_finish_hands_out_each_frame_once(frames):
    odometry = KeyframeOdometry(GeometricBackbone(), Survival())
    early = [placed for frame in frames[:9] for placed in odometry.process(frame).final]
    assert len(early) + len(odometry.pending) == 9
    assert len(early) + len(odometry.finish()) == 9
    assert odometry.finish() == ()
    assert KeyframeOdometry(GeometricBackbone(), Survival()).finish() == ()
