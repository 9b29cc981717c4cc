# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Degenerate input: the odometry reports it, resumes, and its trajectory stays continuous."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from odometry_scenes import RATE_NS, OdometryRun, frames_of, restamped, run, with_image

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation import metrics
from kfvo_ros.keyframes.heuristics import EveryFrame, Survival
from kfvo_ros.odometry.keyframe_odometry import WINDOW_SIZE, KeyframeOdometry
from kfvo_ros.sequences.base import Frame
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.trajectory import Trajectory

POLICIES = pytest.mark.parametrize('policy', [EveryFrame, Survival])
COUNT = 44


@pytest.fixture(scope='module')
def frames() -> tuple[Frame, ...]:
    return frames_of(0, COUNT)


def run_and_check(frames: Sequence[Frame], policy=Survival, **options) -> OdometryRun:
    """Run and assert what holds for every input."""
    result = run(frames, policy(), **options)
    assert [pose.stamp_ns for pose in result.final] == [frame.stamp_ns for frame in frames]
    for update in result.updates:
        assert np.isfinite(update.T_world_camera).all()
        assert np.isfinite(update.covariance).all()
        assert update.median_depth is None or 0.0 < update.median_depth < np.inf
    assert np.isfinite(result.poses).all()
    R = result.poses[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (len(R), 1, 1)),
                               atol=1e-9)
    for pose, frame_pose in zip(result.emitted_poses, result.final):
        assert np.array_equal(pose, frame_pose.T_world_camera)
    return result


def steps(result: OdometryRun) -> np.ndarray:
    """Return the translation of each frame over the median one of the run."""
    length = np.linalg.norm(np.diff(result.poses[:, :3, 3], axis=0), axis=1)
    return length / np.median(length[length > 0.0])


def relative_error(result: OdometryRun, indices: list[int], seed: int = 0) -> float:
    """Return the ATE over some frames as a share of their path."""
    truth = SyntheticSequence(seed, 'smooth', COUNT).ground_truth().trajectory.select(indices)
    estimate = Trajectory(truth.stamps_ns, result.poses[indices])
    error = metrics.absolute_trajectory_error(estimate, truth)
    return error.rmse / error.path_length


def with_blank_images(frames, first: int, count: int, value: int) -> list[Frame]:
    """Return the frames with `count` images from `first` of one grey `value`."""
    return [with_image(frame, np.full_like(frame.image, value))
            if first <= index < first + count else frame for index, frame in enumerate(frames)]


@pytest.mark.parametrize(('policy', 'value'), [(EveryFrame, 0), (Survival, 255), (Survival, 128)])
def test_images_without_texture_are_lost_at_the_origin(frames, policy, value):
    result = run_and_check(with_blank_images(frames[:16], 0, 16, value), policy)
    assert set(result.statuses) == {'lost'}
    assert not any(update.is_keyframe for update in result.updates)
    assert np.array_equal(result.poses, np.tile(np.eye(4), (16, 1, 1)))


@pytest.mark.parametrize(('policy', 'count'), [(Survival, 1), (EveryFrame, 3), (Survival, 9)])
def test_black_images_at_the_start(frames, policy, count):
    result = run_and_check(with_blank_images(frames, 0, count, 0), policy)
    assert result.statuses == ['lost'] * count + ['ok'] * (COUNT - count)
    assert relative_error(result, list(range(count + 2, COUNT))) < 0.03


@pytest.mark.parametrize(('policy', 'first', 'count', 'value'), [
    (Survival, 20, 1, 0), (EveryFrame, 20, 3, 0), (EveryFrame, 20, 1, 255), (Survival, 20, 2, 255),
    (Survival, 4, 2, 0)])
def test_a_few_blank_images_are_bridged(frames, policy, first, count, value):
    result = run_and_check(with_blank_images(frames, first, count, value), policy)
    assert result.statuses[first:first + count] == ['lost'] * count
    assert set(result.statuses[first + count:]) == {'ok'}
    visible = [index for index in range(COUNT) if not first <= index < first + count]
    assert relative_error(result, visible) < 0.02
    assert steps(result).max() < 5.0 * (count + 1)


@POLICIES
def test_many_black_images_restart_at_the_last_pose(frames, policy):
    result = run_and_check(with_blank_images(frames, 18, 10, 0), policy)
    assert result.statuses == ['ok'] * 18 + ['lost'] * 11 + ['ok'] * 15
    usual = np.median([np.trace(update.covariance) for update in result.updates[8:18]])
    # The motion while lost is unobserved: its uncertainty stays, that of later windows is small.
    assert min(np.trace(update.covariance) for update in result.updates[18:]) > 100.0 * usual
    assert np.trace(result.updates[-1].window_covariance) < 10.0 * usual
    assert steps(result).max() < 6.0
    assert relative_error(result, list(range(18))) < 0.02
    # The segment after it has the shape of the truth; its scale follows from the depths alone.
    assert relative_error(result, list(range(30, COUNT))) < 0.05


@POLICIES
def test_a_cut_to_another_scene_keeps_one_trajectory(frames, policy):
    other = frames_of(5, COUNT)
    joined = restamped([frame.image for frame in (*frames[:30], *other[:40])], frames[0].camera)
    result = run_and_check(joined, policy)
    assert 'lost' in result.statuses[30:36]
    assert set(result.statuses[45:]) == {'ok'}
    assert steps(result).max() < 6.0
    moved = np.linalg.norm(result.poses[-1, :3, 3] - result.poses[40, :3, 3])
    assert moved > 3.0 * np.median(np.linalg.norm(np.diff(result.poses[:, :3, 3], axis=0), axis=1))


def test_poses_become_final_after_a_restart():
    """Frames relative to keyframes of the old window must not stay pending, nor hold memory."""
    first, other = frames_of(0, COUNT), frames_of(5, COUNT)
    joined = restamped([frame.image for frame in (*first[:20], *other)], first[0].camera)
    odometry = KeyframeOdometry(GeometricBackbone(), EveryFrame())
    pending = []
    for frame in joined:
        odometry.process(frame)
        pending.append(len(odometry.pending))
    assert max(pending) < 2 * WINDOW_SIZE + 8
    assert pending[-1] == WINDOW_SIZE - 1


@POLICIES
def test_repeated_images_stand_still(frames, policy):
    images = [frame.image for frame in frames]
    repeated = [*images[:20], *[images[19]] * 12, *images[20:]]
    result = run_and_check(restamped(repeated, frames[0].camera), policy)
    assert 'lost' not in result.statuses
    still = result.poses[20:32, :3, 3]
    usual = np.median(np.linalg.norm(np.diff(result.poses[:20, :3, 3], axis=0), axis=1))
    assert np.linalg.norm(still - still[0], axis=1).max() < 0.5 * usual
    truth = SyntheticSequence(0, 'smooth', COUNT).ground_truth().trajectory
    visible = [*range(20), *range(32, COUNT + 12)]
    error = metrics.absolute_trajectory_error(
        Trajectory(truth.stamps_ns, result.poses[visible]), truth)
    assert error.rmse < 0.02 * error.path_length


def test_every_image_twice(frames):
    doubled = [frame.image for frame in frames[:20] for _ in range(2)]
    result = run_and_check(restamped(doubled, frames[0].camera))
    assert 'lost' not in result.statuses
    assert relative_error(OdometryRun([], result.final[::2], []), list(range(20))) < 0.03


@pytest.mark.parametrize(('policy', 'noise'), [
    (EveryFrame, 0.0), (EveryFrame, 4.0), (Survival, 4.0)])
def test_standstill_from_the_start(frames, policy, noise):
    rng = np.random.default_rng(0)
    images = [np.clip(frames[0].image + noise * rng.normal(size=frames[0].image.shape), 0, 255
                      ).astype(np.uint8) for _ in range(24)]
    result = run_and_check(restamped(images, frames[0].camera), policy)
    assert 'lost' not in result.statuses
    assert set(result.statuses[1:]) == {'held'}
    depth = np.median([update.median_depth for update in result.updates[1:]])
    assert metrics.extent(result.trajectory) / depth < 0.02
    assert metrics.max_rotation_deg(result.trajectory) < 1.0


CAMERA = Camera(320, 240, 400.0, 400.0, 159.5, 119.5)


def rotated_images(angles: np.ndarray) -> list[np.ndarray]:
    """Return images of a camera that rotates by angles (N, 3) [rad] on the spot."""
    sequence = SyntheticSequence(0, 'smooth', 1)
    wide, image = sequence.camera, sequence.frame(0).image
    result = []
    for R_wide_camera in geometry.exp_so3(angles):
        H = wide.matrix @ R_wide_camera @ np.linalg.inv(CAMERA.matrix)
        result.append(cv2.warpPerspective(image, H, (CAMERA.width, CAMERA.height),
                                          flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP))
    return result


def test_pure_rotation_from_the_start():
    along = np.linspace(0.0, 1.0, 30)[:, None]
    angles = (along - 0.5) * np.array([0.06, 0.35, 0.1])
    result = run_and_check(restamped(rotated_images(angles), CAMERA))
    assert 'lost' not in result.statuses
    assert result.statuses.count('held') > 20
    truth = geometry.exp_so3(angles)
    error = np.swapaxes(geometry.exp_so3(angles[:1]).transpose(0, 2, 1) @ truth, 1, 2
                        ) @ result.poses[:, :3, :3]
    assert np.degrees(geometry.rotation_angle(error)).max() < 1.0
    depth = np.median([update.median_depth for update in result.updates[1:]])
    assert metrics.extent(result.trajectory) / depth < 0.05


@POLICIES
def test_rotation_and_back_after_translation(frames, policy):
    """The last image is warped by a rotation and back: the camera does not translate."""
    sequence = SyntheticSequence(0, 'smooth', 26)
    images = [frame.image for frame in frames[:26]]
    swing = 0.06 * np.sin(np.linspace(0.0, np.pi, 14))
    last, K = sequence.frame(25), frames[0].camera.matrix
    for angle in swing:
        R = geometry.exp_so3(np.array([0.0, angle, 0.5 * angle]))
        H = sequence.camera.matrix @ R @ np.linalg.inv(K)
        images.append(cv2.warpPerspective(last.image, H, (320, 240),
                                          flags=cv2.INTER_AREA | cv2.WARP_INVERSE_MAP))
    result = run_and_check(restamped(images, frames[0].camera), policy)
    assert 'lost' not in result.statuses
    turn = result.poses[26:]
    travelled = np.linalg.norm(result.poses[25, :3, 3] - result.poses[0, :3, 3])
    assert np.linalg.norm(turn[:, :3, 3] - turn[0, :3, 3], axis=1).max() < 0.1 * travelled
    angles = geometry.rotation_angle(geometry.relative(turn[0], turn)[:, :3, :3])
    np.testing.assert_allclose(angles, np.hypot(swing, 0.5 * swing), atol=0.01)


@pytest.mark.parametrize('count', [1, 2, 3])
def test_very_short_sequences(frames, count):
    result = run_and_check(frames[:count])
    assert np.array_equal(result.poses[0], np.eye(4))
    assert [update.is_keyframe for update in result.updates] == [True] * count
    assert result.updates[0].final == ()


@pytest.mark.parametrize(('width', 'height'), [(64, 48), (32, 24), (16, 12), (3, 2)])
def test_tiny_images(width, height):
    run_and_check(list(SyntheticSequence(3, 'smooth', 20, width, height)))


def test_independent_noise_images_are_lost():
    camera = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        images = [rng.integers(0, 256, (120, 160), dtype=np.uint8) for _ in range(60)]
        assert set(run_and_check(restamped(images, camera)).statuses) == {'lost'}


def test_few_corners_give_finite_poses():
    """Five dots are too few to be tracked reliably, and must not raise an error."""
    images = []
    for index in range(20):
        image = np.full((240, 320), 120, dtype=np.uint8)
        for x, y in [(60, 60), (200, 80), (120, 170), (260, 190), (90, 120)]:
            cv2.circle(image, (x + 3 * index, y), 6, 20, -1)
        images.append(image)
    run_and_check(restamped(images, CAMERA))


def test_a_planar_scene_is_tracked():
    """All points on one plane: a degeneracy of the fundamental matrix."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).integers(
        0, 256, (480, 640), dtype=np.uint8), (0, 0), 2.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    images = [np.ascontiguousarray(texture[40:280, 40 + 6 * n:360 + 6 * n]) for n in range(30)]
    result = run_and_check(restamped(images, CAMERA))
    assert 'lost' not in result.statuses
    steps_taken = np.linalg.norm(np.diff(result.poses[:, :3, 3], axis=0), axis=1)
    assert steps_taken.max() < 4.0 * np.median(steps_taken)


def test_images_of_another_size_are_an_error(frames):
    odometry = KeyframeOdometry(GeometricBackbone(), Survival())
    final = [frame_pose for frame in frames[:9] for frame_pose in odometry.process(frame).final]
    small = Frame(frames[9].stamp_ns, frames[9].image[:120, :160], frames[9].camera)
    with pytest.raises(KfvoError, match='320x240.*160x120') as error:
        odometry.process(small)
    assert '\n' not in str(error.value)
    final += odometry.process(frames[10]).final  # the right size is still accepted
    assert len(final) + len(odometry.finish()) == 10


def test_a_camera_without_calibration_is_an_error(frames):
    with pytest.raises(KfvoError, match='calibrat'):
        run([Frame(RATE_NS, frames[0].image, None)])


def test_colour_images_are_converted_to_grey(frames):
    colour = [with_image(frame, np.repeat(frame.image[..., None], 3, axis=2))
              for frame in frames[:10]]
    np.testing.assert_allclose(run(colour).poses, run(frames[:10]).poses, atol=1e-9)
