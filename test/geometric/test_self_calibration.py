# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test that windows correct a wrong calibration and leave a right one alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from odometry_scenes import CAMERA, PointCloud, moving_poses, run

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Estimate, Points, Window, WindowPrior
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.initialisation import Initialiser
from kfvo_ros.backbones.geometric.keyframe_history import (
    HistoryFrames,
    KeyframeHistory,
    history_of,
)
from kfvo_ros.backbones.geometric.observations import FrameTracks, build_track_table
from kfvo_ros.backbones.geometric.self_calibration import (
    CALIBRATION_SIGMAS,
    MIN_TRACK_LENGTH,
    IntrinsicsFilter,
    marginal_information,
)
from kfvo_ros.backbones.geometric.window import Solution, solve
from kfvo_ros.camera import Camera
from kfvo_ros.evaluation import metrics
from kfvo_ros.keyframes.heuristics import Survival
from kfvo_ros.sequences.base import Frame
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence

WANDERING_ROTATIONS = geometry.make_transform(
    geometry.exp_so3(0.08 * np.sin(np.arange(24).reshape(8, 3))), np.zeros((8, 3)))
"""With a constant direction a wrong focal length equals a longer scene."""


def solved_window(seed: int, errors: Sequence[float], noise: float) -> Solution:
    """Return a solved window of a camera with intrinsics `errors`, missing ones 0."""
    cloud = PointCloud(seed, noise=noise)
    poses = moving_poses(8, 0.25) @ WANDERING_ROTATIONS
    poses = geometry.invert(poses[0]) @ poses
    frames = []
    for index, pose in enumerate(poses):
        frame = cloud.encode(index, pose).payload
        e0, e1, e2, *axis = [*errors, 0.0, 0.0, 0.0][:5]
        r2 = (frame.points ** 2).sum(axis=1)
        scale = 1.0 + e0 + e1 * r2 + e2 * r2 * r2
        frames.append(replace(frame, points=frame.points * scale[:, None] + axis))
    return solve_without_prior(frames)


def solve_without_prior(frames: Sequence[FrameTracks]) -> Solution:
    """Return the solution of a stream's first window."""
    table = build_track_table(frames, 0, IntrinsicsFilter())
    return solve(table, Initialiser(CAMERA.fx, 0), None, HistoryFrames())


def updated(intrinsics_filter: IntrinsicsFilter, window: Solution,
            indices: Sequence[int] = range(8)) -> IntrinsicsFilter:
    return intrinsics_filter.update(window.problem, window.state, window.noise, indices)


@pytest.mark.parametrize('errors', [
    (0.006, 0.0, 0.0, 0.0, 0.0), (0.0, -0.006, 0.0, 0.0, 0.0), (-0.004, 0.005, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.006, 0.0, 0.0), (0.0, 0.0, 0.0, 0.003, -0.002),
    (0.004, -0.005, 0.003, -0.002, 0.002)])
def test_exact_tracks_determine_the_errors(errors):
    window = solved_window(1, errors, 0.0)
    information, vector = marginal_information(window.problem, window.state)
    assert np.allclose(np.linalg.solve(information, vector), errors, atol=4e-4)


def test_errors_from_noisy_tracks_are_consistent_with_their_information():
    """With rays fixed to the host's observation its noise would bias the errors."""
    noise, squares, information, vector = 0.4, [], np.zeros((5, 5)), np.zeros(5)
    for seed in range(40):
        window = solved_window(seed, (0.0, 0.0), noise)
        one, one_vector = (each / noise ** 2
                           for each in marginal_information(window.problem, window.state))
        squares.append(one_vector @ np.linalg.solve(one, one_vector))
        information, vector = information + one, vector + one_vector
    assert vector @ np.linalg.solve(information, vector) < 18.0, 'chi square of 5, P = 1/300'
    assert 1.25 < np.mean(squares) < 7.5, 'chi square of 5 has mean 5; the loss is conservative'


def test_short_tracks_are_not_used():
    """Large errors of short tracks change nothing."""
    window = solved_window(3, (0.0, 0.005), 0.3)
    short = np.arange(window.problem.mask.shape[1]) % 2 == 0
    mask, image_points = window.problem.mask.copy(), window.problem.image_points.copy()
    mask[MIN_TRACK_LENGTH - 1:, short] = False
    image_points[:, :, short] *= 1.1
    mixed = window.problem._replace(mask=mask, image_points=image_points)
    long = window.problem.select_points(~short), window.state.select_points(~short)
    for found, expected in zip(marginal_information(mixed, window.state),
                               marginal_information(*long), strict=True):
        np.testing.assert_allclose(found, expected)


def test_each_update_reduces_the_variance():
    window = solved_window(3, (0.0, 0.005), 0.3)
    first = updated(IntrinsicsFilter(), window)
    second = updated(first, window, range(8, 16))
    assert 0.0 < first.errors[1] < 0.005
    assert (first.last_frame, second.last_frame) == (7, 15)
    variances = [np.linalg.inv(each.information)[1, 1] for each in (first, second)]
    assert CALIBRATION_SIGMAS[1] ** 2 > variances[0] > variances[1]


def test_frames_used_before_do_not_count_again():
    window = solved_window(3, (0.0, 0.005), 0.3)
    new, half_new = (IntrinsicsFilter(last_frame=index) for index in (-1, 3))
    full, half = updated(new, window), updated(half_new, window)
    assert (half_new.new_share(range(8)), half.new_share(range(8))) == (0.5, 0.0)
    np.testing.assert_allclose(half.information - IntrinsicsFilter().information,
                               0.5 * (full.information - IntrinsicsFilter().information))


def test_frames_far_apart_carry_more_information_than_successive_ones():
    window = solved_window(3, (0.0, 0.005), 0.3)
    near, far = (updated(IntrinsicsFilter(), window, range(0, 8 * gap, gap)) for gap in (1, 4))
    assert np.linalg.eigvalsh(far.information - near.information).min() > 0.0
    assert abs(far.errors[1] - 0.005) < abs(near.errors[1] - 0.005)
    independent, _ = marginal_information(window.problem, window.state)
    most = independent / window.noise ** 2 + IntrinsicsFilter().information
    assert np.linalg.eigvalsh(most - far.information).min() > 0.0


def test_window_without_parallax_changes_little():
    cloud = PointCloud(0, noise=0.3)
    window = solve_without_prior([cloud.encode(index, np.eye(4)).payload for index in range(8)])
    found = updated(IntrinsicsFilter(), window)
    assert np.isfinite(found.errors).all()
    assert (np.abs(found.errors) < CALIBRATION_SIGMAS).all()


def test_undistort_without_errors_changes_no_bit_and_is_bounded_at_the_rim_of_a_fisheye():
    points = np.random.default_rng(0).normal(size=(50, 2))
    assert IntrinsicsFilter().undistort(points).tobytes() == points.tobytes()
    far, errors = np.array([[5.6, 0.0]]), np.array([0.0, 0.01, 0.0, 0.0, 0.0])
    assert np.allclose(IntrinsicsFilter(errors).undistort(far), far, rtol=0.021)


class RecordingBackbone(GeometricBackbone):
    """Keeps the memory of each estimate."""

    def __init__(self) -> None:
        super().__init__()
        self.memories: list[KeyframeHistory] = []

    def estimate(self, windows: Sequence[Window]) -> list[Estimate]:
        estimates = super().estimate(windows)
        self.memories += [estimate.memory for estimate in estimates]
        return estimates


SEQUENCE = SyntheticSequence(0, 'smooth', 150)
K1 = 0.01


def frames(camera: Camera, black: range = range(0)) -> Iterator[Frame]:
    for index, frame in enumerate(SEQUENCE):
        yield replace(frame, camera=camera,
                      image=np.zeros_like(frame.image) if index in black else frame.image)


def wrong_calibration(k1: float, readout_s: float = 0.0, cx: float = 0.0) -> Camera:
    """Return a wrong calibration of the sequence's camera, which has no distortion.

    `cx` [px] is the error of the principal point.
    """
    return replace(SEQUENCE.camera, cx=SEQUENCE.camera.cx + cx, distortion_model='plumb_bob',
                   distortion=(k1, 0.0, 0.0, 0.0), readout_s=readout_s)


@pytest.mark.parametrize(('k1', 'cx', 'share'), [(K1, 0.0, 0.6), (0.0, 2.0, 0.9)])
def test_wrong_calibration_is_corrected(k1, cx, share):
    """The trajectory's error is compared with that of a run without self-calibration."""
    errors = {}
    for readout_s in (0.0, 1e-9):
        backbone = RecordingBackbone()
        result = run(frames(wrong_calibration(k1, readout_s, cx)), Survival(), backbone)
        errors[readout_s] = metrics.absolute_trajectory_error(
            result.trajectory, SEQUENCE.ground_truth().trajectory).rmse
        found = backbone.memories[-1].intrinsics_filter
        if readout_s:
            assert found.last_frame == -1, 'not used with a rolling shutter'
            assert all(update.intrinsics is None for update in result.updates)
        else:
            axis = -cx / SEQUENCE.camera.fx
            assert abs(found.errors[1] + k1) < 0.3 * K1
            assert abs(found.errors[0]) < 0.005
            assert abs(found.errors[3] - axis) < 0.0025
    assert errors[0.0] < share * errors[1e-9]


def test_intrinsics_are_published_once_converged():
    true = SEQUENCE.camera
    published = [update.intrinsics for update in run(frames(true.miscalibrated(0.01, 0.0)),
                                                     Survival()).updates]
    assert all(K is None for K in published[:8])
    assert np.allclose(published[-1], true.matrix, rtol=0.004)


def test_intrinsics_project_undistorted_points_to_their_pixels():
    found = IntrinsicsFilter(np.array([0.01, 0.0, 0.0, 0.002, -0.001]))
    points = np.array([[0.3, -0.2]])
    ray = np.append(found.undistort(points), 1.0)
    np.testing.assert_allclose(found.intrinsics(CAMERA) @ ray,
                               CAMERA.matrix @ np.append(points, 1.0), rtol=1e-12)


def test_right_calibration_is_left_alone():
    backbone = RecordingBackbone()
    run(frames(SEQUENCE.camera), Survival(), backbone)
    found = backbone.memories[-1].intrinsics_filter
    assert found.last_frame > 0
    assert abs(found.errors[1]) < 0.2 * K1


def test_lost_points_keep_the_intrinsics_and_no_other_memory():
    found = IntrinsicsFilter(np.array([0.001, 0.002, 0.0, 0.0, 0.0]), last_frame=7)
    memory = KeyframeHistory(measured=True, windows=20, intrinsics_filter=found)
    prior = WindowPrior(np.eye(4)[None], np.eye(4), None, memory)
    kept = history_of(prior)
    assert kept.intrinsics_filter is found
    assert (kept.windows, kept.initialised, kept.frames) == (0, False, ())
    assert history_of(replace(prior, points=Points(*np.zeros((3, 0))))) is memory
    assert history_of(None).intrinsics_filter.last_frame == -1


def test_intrinsics_survive_darkness():
    backbone = RecordingBackbone()
    run(frames(wrong_calibration(K1), range(100, 115)), Survival(), backbone)
    windows = [memory.windows for memory in backbone.memories]
    restart = next(index for index in range(1, len(windows))
                   if windows[index] < windows[index - 1])
    before, after = (backbone.memories[index].intrinsics_filter
                     for index in (restart - 1, restart))
    assert before.errors[1] < -0.3 * K1
    assert np.array_equal(before.errors, after.errors)
