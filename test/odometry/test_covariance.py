# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances and state from window to window, against sampled motions."""

from __future__ import annotations

import numpy as np
import pytest
from odometry_scenes import RATE_NS, frames_of, restamped

from kfvo_ros import geometry
from kfvo_ros.backbones.base import (
    Backbone,
    Encoded,
    Estimate,
    Points,
    Status,
    Stream,
    lost_estimate,
)
from kfvo_ros.keyframes.heuristics import EveryFrame
from kfvo_ros.odometry.keyframe_odometry import MAX_LOST_FRAMES, KeyframeOdometry
from kfvo_ros.odometry.updates import Update
from kfvo_ros.odometry.window_prior import (
    WindowState,
    propagate_covariance,
    rotate_covariance,
    scale_poses,
    transform_points,
)
from kfvo_ros.sequences.base import Frame

RNG = np.random.default_rng(4)
T_WORLD_ANCHOR = geometry.make_transform(geometry.exp_so3(np.array([0.4, -0.9, 0.3])),
                                         np.array([2.0, -1.0, 0.5]))
RELATIVE = np.diag([1.0, 4.0, 9.0, 0.01, 0.04, 0.09]) * 1e-4
UNIT = 3.0


def sample_errors(covariance: np.ndarray, count: int = 200_000) -> np.ndarray:
    """Return samples (N, 6) of a normal distribution."""
    return RNG.multivariate_normal(np.zeros(6), covariance, count)


def test_rotate_covariance_against_samples():
    errors = sample_errors(RELATIVE)
    rotation = T_WORLD_ANCHOR[:3, :3]
    transformed = np.concatenate([UNIT * errors[:, :3] @ rotation.T, errors[:, 3:] @ rotation.T],
                                 axis=1)
    expected = np.cov(transformed.T)
    found = rotate_covariance(RELATIVE, T_WORLD_ANCHOR, UNIT)
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())
    # Rotations are not scaled. The largest axis is the third column, not the third row.
    assert np.trace(found[3:, 3:]) == pytest.approx(np.trace(RELATIVE[3:, 3:]))
    axis = np.linalg.eigh(found[:3, :3])[1][:, -1]
    assert abs(axis @ rotation[:, 2]) == pytest.approx(1.0)


def test_rotation_of_the_reference_moves_the_frame_by_the_lever_arm():
    offset = np.array([2.0, 0.0, 0.0])
    reference = np.zeros((6, 6))
    reference[5, 5] = 0.01  # rotation about z moves a point on x along y
    found = propagate_covariance(np.zeros((6, 6)), reference, offset)
    assert found[1, 1] == pytest.approx(0.04)
    assert found[1, 5] == pytest.approx(0.02)  # dy = +x dyaw
    assert found[0, 0] == found[2, 2] == 0.0


def test_propagate_covariance_against_samples():
    reference = RELATIVE @ RELATIVE.T / RELATIVE.max() + RELATIVE
    offset = np.array([0.7, -1.9, 1.1])
    of_reference, of_frame = sample_errors(reference), sample_errors(RELATIVE)
    rotation = geometry.exp_so3(of_reference[:, 3:])
    positions = of_reference[:, :3] + (rotation @ offset - offset) + of_frame[:, :3]
    rotations = of_reference[:, 3:] + of_frame[:, 3:]
    expected = np.cov(np.concatenate([positions, rotations], axis=1).T)
    found = propagate_covariance(RELATIVE, reference, offset)
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())


def test_scale_poses_and_transform_points():
    poses = np.stack([np.eye(4), T_WORLD_ANCHOR])
    scaled = scale_poses(poses, UNIT)
    np.testing.assert_allclose(scaled[1, :3, 3], [6.0, -3.0, 1.5])
    np.testing.assert_array_equal(scaled[1, :3, :3], T_WORLD_ANCHOR[:3, :3])
    assert poses[1, 0, 3] == 2.0  # the argument stays
    points = Points(np.array([7]), np.array([[1.0, 2.0, 3.0]]), np.ones(1))
    found = transform_points(points, T_WORLD_ANCHOR, UNIT).positions[0]
    np.testing.assert_allclose(
        found, T_WORLD_ANCHOR[:3, :3] @ [3.0, 6.0, 9.0] + T_WORLD_ANCHOR[:3, 3])
    assert transform_points(None, T_WORLD_ANCHOR, UNIT) is None


class KnownBackbone(Backbone):
    """Estimates true poses in its own unit; is lost at the stamps in `lost_ns`."""

    name = 'known'
    descriptor_size = 1
    default_scale_rule = 'translation'

    def __init__(self, *lost_ns: int) -> None:
        self.lost_ns = lost_ns
        self.priors = []

    def open(self, camera):
        class PlainStream(Stream):
            def encode(self, frame):
                return Encoded(frame.stamp_ns, np.ones(1, dtype=np.float32))
        return PlainStream()

    def estimate(self, windows):
        self.priors += [window.prior for window in windows]
        return [self._estimate(window) for window in windows]

    def _estimate(self, window):
        if window.frames[-1].stamp_ns in self.lost_ns:
            return lost_estimate(window, memory='memory')
        world = np.stack([pose_at(frame.stamp_ns) for frame in window.frames])
        poses = scale_poses(geometry.relative(world[0], world), 1.0 / UNIT)
        poses[0] = np.eye(4)
        covariance = np.arange(len(poses))[:, None, None] * RELATIVE
        return Estimate(poses, lambda: covariance, None, np.zeros(0, dtype=np.float32),
                        memory='memory')


def pose_at(stamp_ns: int) -> np.ndarray:
    """Return the true pose of the frame with this stamp."""
    along = stamp_ns / RATE_NS - 1.0
    return geometry.make_transform(geometry.exp_so3(np.array([0.02, 0.05, 0.01]) * along),
                                   np.array([along, np.sin(0.3 * along), 0.2 * along]))


def frames(count: int) -> list[Frame]:
    """Return frames with regular stamps."""
    given = frames_of(0, 60)
    return restamped([frame.image for frame in given[:count]], given[0].camera)


def process(backbone: Backbone, count: int, **options) -> list[Update]:
    """Return the updates of frames that are all kept."""
    odometry = KeyframeOdometry(backbone, EveryFrame(), window_size=3, **options)
    return [odometry.process(frame) for frame in frames(count)]


def test_covariance_is_propagated_from_anchor_to_anchor():
    updates = process(KnownBackbone(), 5)
    assert not updates[0].covariance.any()
    anchor, of_anchor = np.eye(4), np.zeros((6, 6))
    unit = np.linalg.norm(updates[1].T_world_camera[:3, 3]) / np.linalg.norm(
        pose_at(2 * RATE_NS)[:3, 3])  # trajectory units per metre
    for number, update in enumerate(updates[1:], 1):
        # Window: anchor max(number - 2, 0), then the frames up to this one.
        size = min(number, 2)
        window = rotate_covariance(size * RELATIVE, anchor, UNIT * unit)
        np.testing.assert_allclose(update.window_covariance, window, rtol=1e-6, atol=1e-15)
        offset = update.T_world_camera[:3, 3] - anchor[:3, 3]
        np.testing.assert_allclose(update.covariance,
                                   propagate_covariance(window, of_anchor, offset), rtol=1e-6,
                                   atol=1e-15)
        if number >= 2:  # the next anchor is the second frame of this window
            pose = scale_poses(pose_at(number * RATE_NS), unit)
            own = rotate_covariance(RELATIVE, anchor, UNIT * unit)
            of_anchor = propagate_covariance(own, of_anchor, pose[:3, 3] - anchor[:3, 3])
            anchor = pose


def test_without_covariance_all_are_zero():
    for update in process(KnownBackbone(), 5, with_covariance=False):
        assert not update.covariance.any() and not update.window_covariance.any()


def test_a_lost_frame_keeps_pose_and_scale_with_large_covariance():
    last = 5 * RATE_NS
    backbone = KnownBackbone(last)
    *_, before, update, after = process(backbone, 6)
    assert update.status is Status.LOST and not update.is_keyframe
    np.testing.assert_allclose(update.T_world_camera, before.T_world_camera, atol=1e-12)
    assert np.diag(update.window_covariance).min() > 1.0
    assert np.diag(after.covariance).max() < 1.0
    # The unit of the backbone's memory stays.
    assert backbone.priors[-1].memory_scale == backbone.priors[-2].memory_scale != 1.0
    assert backbone.priors[-1].memory == 'memory'


@pytest.mark.parametrize('count', [MAX_LOST_FRAMES - 1, MAX_LOST_FRAMES])
def test_the_window_restarts_after_max_lost_frames(count):
    lost_stamps_ns = [(5 + index) * RATE_NS for index in range(count)]
    backbone = KnownBackbone(*lost_stamps_ns)
    updates = process(backbone, 4 + count + 3)
    last_lost, first = updates[3 + count], updates[4 + count]
    restarted = count == MAX_LOST_FRAMES
    assert (first.status is Status.LOST) == restarted
    if not restarted:
        assert np.diag(first.covariance).max() < 1.0
        return
    # It starts at the pose and covariance of the last lost frame; the covariance stays large.
    np.testing.assert_allclose(first.T_world_camera, last_lost.T_world_camera, atol=1e-9)
    np.testing.assert_array_equal(first.covariance, last_lost.covariance)
    assert first.is_keyframe
    assert updates[5 + count].status is Status.OK
    assert np.diag(updates[5 + count].covariance).min() > 1.0
    assert np.diag(updates[5 + count].window_covariance).max() < 1.0


def test_a_prior_is_relative_to_the_anchor():
    points = Points(np.array([3]), np.array([[0.0, 0.0, 5.0]]), np.ones(1))
    state = WindowState(T_WORLD_ANCHOR, points, 'memory', 0.25)

    class Posed:
        T_world_camera = T_WORLD_ANCHOR

    prior = state.prior_of([Posed()])
    np.testing.assert_array_equal(prior.T_anchor_frame[0], np.eye(4))
    np.testing.assert_allclose(prior.T_anchor_latest, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(prior.points.positions[0],
                               T_WORLD_ANCHOR[:3, :3].T @ ([0.0, 0.0, 5.0]
                                                           - T_WORLD_ANCHOR[:3, 3]))
    assert (prior.memory, prior.memory_scale) == ('memory', 0.25)
    assert WindowState(T_WORLD_ANCHOR).prior_of([Posed()]) is None
