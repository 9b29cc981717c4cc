# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test the geometric backbone against its contract and the true motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odometry_scenes import (
    CAMERA,
    PointCloud,
    certain_tracks,
    frames_of,
    moving_poses,
    run,
    turning_poses,
    window,
)

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Estimate, Status, Window, WindowPrior
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.heuristics import Survival
from kfvo_ros.odometry import window_prior
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.tracking.tracker import common_pixels


def second_window(backbone: GeometricBackbone, poses: np.ndarray, noise: float) -> Window:
    """Return the window one frame after the first, with the first estimate as its prior."""
    first = window(poses[:-1], noise=noise, backbone=backbone)
    estimate = backbone.estimate([first])[0]
    newest = PointCloud(0, noise=noise).encode(len(poses) - 1, poses[-1])
    prior = WindowPrior(estimate.T_anchor_frame, estimate.T_anchor_frame[-1], estimate.points,
                           estimate.memory)
    return Window(first.stream, (*first.frames, newest), prior)


def arrays_of(estimate: Estimate) -> list[np.ndarray]:
    points = estimate.points
    return [estimate.T_anchor_frame, estimate.covariance, points.ids, points.positions,
            points.information, estimate.signals, estimate.memory.T_anchor_frame]


def assert_same(one: Estimate, other: Estimate) -> None:
    assert one.status is other.status
    for a, b in zip(arrays_of(one), arrays_of(other), strict=True):
        assert a.tobytes() == b.tobytes()


def test_track_with_one_wrong_observation_is_an_outlier():
    backbone = GeometricBackbone()
    clean = window(moving_poses(8), backbone=backbone)
    known = backbone.estimate([clean])[0].points.ids
    frame = clean.frames[3].payload
    wrong = np.intersect1d(known, frame.tracks.ids)[10]
    assert wrong in clean.frames[5].payload.tracks.ids
    frame.points[frame.tracks.ids == wrong] += 5.0 / CAMERA.fx
    left = backbone.estimate([clean])[0].points.ids
    assert np.array_equal(left, np.setdiff1d(known, [wrong]))


def test_window_without_any_fit_is_lost():
    """Outlier bounds that grow with the noise without limit would accept everything."""
    backbone = GeometricBackbone()
    assert backbone.estimate([window(moving_poses(8), 0, 12.0, backbone)])[0].status is Status.LOST


def test_windows_in_one_call_are_independent():
    backbone = GeometricBackbone()
    a = window(moving_poses(8), 1, 0.3, backbone)
    b = second_window(backbone, moving_poses(8), 0.3)
    together = backbone.estimate([a, b])
    apart = backbone.estimate([a]) + backbone.estimate([b])
    for one, other in zip(together, apart, strict=True):
        assert_same(one, other)
    assert together[0].T_anchor_frame.tobytes() != together[1].T_anchor_frame.tobytes()
    assert backbone.estimate([]) == []


def test_estimate_has_no_side_effects():
    backbone = GeometricBackbone()
    with_prior = second_window(backbone, moving_poses(8), 0.3)
    inputs = [array.copy() for frame in with_prior.frames
              for array in (frame.payload.points, frame.payload.tracks.pixels)]
    before = with_prior.prior.T_anchor_frame.copy(), with_prior.prior.points.positions.copy()
    first = backbone.estimate([with_prior])[0]
    kept = [array.copy() for array in arrays_of(first)]
    assert_same(first, backbone.estimate([with_prior])[0])
    for array, copy in zip(arrays_of(first), kept):
        assert np.array_equal(array, copy)
    after = [array for frame in with_prior.frames
             for array in (frame.payload.points, frame.payload.tracks.pixels)]
    assert all(np.array_equal(x, y) for x, y in zip(inputs, after))
    assert np.array_equal(before[0], with_prior.prior.T_anchor_frame)
    assert np.array_equal(before[1], with_prior.prior.points.positions)


@pytest.mark.parametrize('frames', [2, 3, 8])
@pytest.mark.parametrize('with_prior', [False, True])
def test_shapes_and_first_pose(frames, with_prior):
    backbone, poses = GeometricBackbone(), moving_poses(frames + with_prior)
    if with_prior:
        given = second_window(backbone, poses, 0.3)
    else:
        given = window(poses, noise=0.3, backbone=backbone)
    estimate, size = backbone.estimate([given])[0], len(poses)
    assert estimate.T_anchor_frame.shape == (size, 4, 4)
    assert estimate.T_anchor_frame.dtype == np.float64
    assert np.array_equal(estimate.T_anchor_frame[0], np.eye(4))
    rotations = estimate.T_anchor_frame[:, :3, :3]
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2),
                               np.tile(np.eye(3), (size, 1, 1)), atol=1e-12)
    assert estimate.covariance.shape == (size, 6, 6)
    assert not estimate.covariance[0].any()
    assert estimate.signals.shape == (len(backbone.signal_names),)
    assert estimate.signals.dtype == np.float32
    assert np.isfinite(estimate.signals).all()
    assert (np.diff(estimate.points.ids) > 0).all()
    assert (estimate.points.information >= 0.0).all()


@pytest.mark.parametrize('seed', range(3))
def test_noise_free_window_is_exact_up_to_scale(seed):
    poses = moving_poses(8)
    backbone = GeometricBackbone()
    estimate = backbone.estimate([window(poses, seed, backbone=backbone)])[0]
    truth = geometry.relative(poses[0], poses)
    found = estimate.T_anchor_frame
    scale = np.linalg.norm(truth[:, :3, 3]) / np.linalg.norm(found[:, :3, 3])
    np.testing.assert_allclose(found[:, :3, :3], truth[:, :3, :3], atol=2e-3)
    np.testing.assert_allclose(scale * found[:, :3, 3], truth[:, :3, 3], atol=5e-3)
    points = PointCloud(seed).points[estimate.points.ids]  # the first camera is the world
    np.testing.assert_allclose(scale * estimate.points.positions, points, rtol=0.02, atol=0.05)
    assert estimate.status is Status.OK
    assert 0.3 < np.median(estimate.points.depths) < 3.0


def test_half_a_pixel_of_noise_stays_small():
    poses, backbone = moving_poses(8), GeometricBackbone()
    estimate = backbone.estimate([window(poses, noise=0.5, backbone=backbone)])[0]
    truth, found = geometry.relative(poses[0], poses), estimate.T_anchor_frame
    scale = np.linalg.norm(truth[:, :3, 3]) / np.linalg.norm(found[:, :3, 3])
    turned = geometry.rotation_angle(np.swapaxes(truth[:, :3, :3], 1, 2) @ found[:, :3, :3])
    assert np.degrees(turned).max() < 0.3
    assert np.linalg.norm(scale * found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.03


def test_start_before_a_wall_finds_the_right_one_of_two_motions():
    """The first frames fit both; later frames resolve the ambiguity."""
    room = SyntheticSequence(77, 'mixed', 20)
    poses = room.ground_truth().trajectory.poses
    ended = run(room).poses
    wrong = geometry.relative(geometry.relative(ended[8], ended[18]),
                              geometry.relative(poses[8], poses[18]))
    assert np.degrees(geometry.rotation_angle(wrong[:3, :3])) < 0.5


def test_prior_keeps_the_unit_of_the_trajectory():
    backbone = GeometricBackbone()
    with_prior = second_window(backbone, moving_poses(8), 0.2)
    known = with_prior.prior.T_anchor_frame
    found = backbone.estimate([with_prior])[0].T_anchor_frame
    ratio = np.linalg.norm(found[1:7, :3, 3]) / np.linalg.norm(known[1:, :3, 3])
    assert abs(np.log(ratio)) < 0.02


@pytest.mark.parametrize('noise', [0.0, 0.3])
def test_covariance_is_symmetric_and_positive(noise):
    backbone = GeometricBackbone()
    for poses in (moving_poses(8), turning_poses(8)):
        covariance = backbone.estimate([window(poses, noise=noise, backbone=backbone)]
                                       )[0].covariance
        assert np.array_equal(covariance, np.swapaxes(covariance, 1, 2))
        values = np.linalg.eigvalsh(covariance)
        assert (values >= -1e-9 * values.max()).all()
        assert (values[-1] > 0.0).all()


@pytest.mark.parametrize('seed', range(3))
def test_covariance_of_a_turning_camera_includes_its_unknown_scale(seed):
    """Its position is known relative to the depth, its scale is not."""
    backbone = GeometricBackbone()
    moving, turning = (
        backbone.estimate([window(poses, seed, 0.3, backbone)])[0]
        for poses in (moving_poses(8), turning_poses(8)))

    def relative_deviation(estimate):
        deviation = np.sqrt(np.trace(estimate.covariance[-1, :3, :3]))
        return deviation / np.linalg.norm(estimate.T_anchor_frame[-1, :3, 3])

    assert relative_deviation(turning) > 1.5 * relative_deviation(moving)
    assert np.median(turning.points.information) < 0.1 * np.median(moving.points.information)


@pytest.mark.parametrize('noise', [0.0, 0.2])
def test_turning_is_held_and_its_rotation_right(noise):
    poses, backbone = turning_poses(8), GeometricBackbone()
    estimate = backbone.estimate([window(poses, noise=noise, backbone=backbone)])[0]
    assert estimate.status is Status.HELD
    error = np.swapaxes(poses[:, :3, :3], 1, 2) @ estimate.T_anchor_frame[:, :3, :3]
    assert np.degrees(geometry.rotation_angle(error)).max() < 0.2
    assert moving_poses(8)[-1, 0, 3] > 0.5  # the same window moving is not held
    assert backbone.estimate([window(moving_poses(8), noise=noise, backbone=backbone)]
                             )[0].status is Status.OK


def test_frame_at_rest_is_not_held_in_a_moving_window():
    """It has no parallax to the last keyframe and enough to those before it."""
    poses, backbone = moving_poses(8), GeometricBackbone()
    poses[-1] = poses[-2]
    estimate = backbone.estimate([window(poses, noise=0.1, backbone=backbone)])[0]
    assert estimate.signals[GeometricBackbone.signal_names.index('parallax')] < np.log1p(1.0)
    assert estimate.status is Status.OK


@pytest.mark.parametrize('unit', [1e-4, 1e3])
def test_window_is_the_same_in_any_unit(unit):
    """The first depth, and so the unit, may be much larger or smaller than later ones."""
    backbone = GeometricBackbone()
    window = second_window(backbone, moving_poses(8), 0.1)
    usual = backbone.estimate([window])[0]
    prior = window.prior
    elsewhere = replace(window, prior=WindowPrior(
        window_prior.scale_poses(prior.T_anchor_frame, unit),
        window_prior.scale_poses(prior.T_anchor_latest, unit),
        window_prior.transform_points(prior.points, np.eye(4), unit), prior.memory, unit))
    other = backbone.estimate([elsewhere])[0]
    np.testing.assert_allclose(window_prior.scale_poses(other.T_anchor_frame, 1.0 / unit),
                               usual.T_anchor_frame, rtol=0.0, atol=1e-5)


def test_frame_without_common_tracks_is_lost_at_the_latest_pose():
    backbone = GeometricBackbone()
    with_prior = second_window(backbone, moving_poses(8), 0.2)
    newest = with_prior.frames[-1]
    others = certain_tracks(newest.tracks.ids + 10_000, newest.tracks.pixels)
    payload = type(newest.payload)(7, others, newest.payload.points)
    unrelated = type(newest)(newest.stamp_ns, newest.descriptor, payload, others)
    lost = backbone.estimate([Window(with_prior.stream, (*with_prior.frames[:-1], unrelated),
                                     with_prior.prior)])[0]
    assert lost.status is Status.LOST
    assert np.array_equal(lost.T_anchor_frame[:-1], with_prior.prior.T_anchor_frame)
    assert np.array_equal(lost.T_anchor_frame[-1], with_prior.prior.T_anchor_latest)
    ok = backbone.estimate([with_prior])[0]
    assert np.trace(lost.covariance[-1]) > 100.0 * np.trace(ok.covariance[-1])
    assert np.isfinite(lost.signals).all()
    assert len(lost.signals) == len(backbone.signal_names)


def test_signals_follow_the_motion():
    backbone = GeometricBackbone()

    def signals_of(poses):
        estimate = backbone.estimate([window(poses, noise=0.2, backbone=backbone)])[0]
        return dict(zip(backbone.signal_names, estimate.signals.tolist(), strict=True))

    slow, fast, turning = map(signals_of, (moving_poses(8, 0.05), moving_poses(8),
                                           turning_poses(8)))
    assert fast['flow'] > slow['flow']
    before, after = common_pixels(*(frame.payload.tracks for frame in window(
        moving_poses(8), noise=0.2, backbone=backbone).frames[-2:]))
    assert np.expm1(fast['flow']) == pytest.approx(  # the flow of the policy optical_flow
        np.linalg.norm(after - before, axis=1).mean())
    assert fast['parallax'] > 2.0 * turning['parallax']
    assert turning['rotation'] == pytest.approx(
        geometry.rotation_angle(turning_poses(2)[1, :3, :3]), rel=0.05)
    assert all(0.0 <= signal['track_survival'] <= 1.0 for signal in (slow, fast, turning))
    assert fast['gap'] == 1.0
    assert fast['depth_information'] > turning['depth_information']


def test_descriptor_ignores_brightness_and_contrast():
    backbone, frame = GeometricBackbone(), frames_of(0, 2)[0]
    brighter = type(frame)(frame.stamp_ns, (frame.image // 2 + 90).astype(np.uint8), frame.camera)
    one, other = (backbone.open(frame.camera).encode(f).descriptor for f in (frame, brighter))
    assert one.shape == (backbone.descriptor_size,)
    assert one.dtype == np.float32
    assert abs(one.mean()) < 1e-4
    assert np.abs(one - other).max() < 0.2 * np.abs(one).max()


def test_streams_of_one_backbone_do_not_disturb_each_other():
    backbone = GeometricBackbone()
    sequences = frames_of(0, 24), frames_of(1, 24)
    odometries = [KeyframeOdometry(backbone, Survival()) for _ in sequences]
    interleaved = [[odometry.process(frame).T_world_camera
                    for odometry, frame in zip(odometries, pair)] for pair in zip(*sequences)]
    for index, frames in enumerate(sequences):
        alone = np.stack([update.T_world_camera for update in run(frames).updates])
        assert np.stack([pair[index] for pair in interleaved]).tobytes() == alone.tobytes()


def test_open_without_a_camera_raises():
    with pytest.raises(KfvoError, match='calibrated camera'):
        GeometricBackbone().open(None)
