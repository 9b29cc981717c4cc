# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a calibration got wrong is learnt from windows, and nothing where nothing is wrong."""

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
from kfvo_ros.backbones.geometric.observations import build_track_table
from kfvo_ros.backbones.geometric.self_calibration import (
    EXPECTED,
    LEAST_VIEWS,
    IntrinsicsFilter,
    marginal,
)
from kfvo_ros.backbones.geometric.window import Solution, solve
from kfvo_ros.camera import Camera
from kfvo_ros.evaluation import metrics
from kfvo_ros.keyframes.heuristics import Survival
from kfvo_ros.sequences.base import Frame
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence

GAZE = geometry.make_transform(geometry.exp_so3(0.08 * np.sin(np.arange(24).reshape(8, 3))),
                               np.zeros((8, 3)))
"""It wanders: straight ahead, an image that is too large is as good as a longer room."""


def solved(seed: int, errors: Sequence[float], noise: float) -> Solution:
    """Return a window of points that are seen through a lens with `errors`, the last ones 0."""
    cloud = PointCloud(seed, noise=noise)
    poses = moving_poses(8, 0.25) @ GAZE
    poses = geometry.invert(poses[0]) @ poses
    views = []
    for index, pose in enumerate(poses):
        view = cloud.encode(index, pose).payload
        e0, e1, e2, *axis = [*errors, 0.0, 0.0, 0.0][:5]
        r2 = (view.points ** 2).sum(axis=1)
        bent = 1.0 + e0 + e1 * r2 + e2 * r2 * r2
        views.append(replace(view, points=view.points * bent[:, None] + axis))
    return solve(build_track_table(views, 0, IntrinsicsFilter()), Initialiser(CAMERA.fx, 0), None, HistoryFrames())


@pytest.mark.parametrize('errors', [
    (0.006, 0.0, 0.0, 0.0, 0.0), (0.0, -0.006, 0.0, 0.0, 0.0), (-0.004, 0.005, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.006, 0.0, 0.0), (0.0, 0.0, 0.0, 0.003, -0.002),
    (0.004, -0.005, 0.003, -0.002, 0.002)])
def test_exact_tracks_tell_the_lens(errors):
    window = solved(1, errors, 0.0)
    information, pull = marginal(window.problem, window.state)
    assert np.allclose(np.linalg.solve(information, pull), errors, atol=4e-4)


def test_noisy_tracks_tell_as_much_as_they_claim():
    """A host's noise taken for truth would be laid to the lens, and claimed to be sure."""
    noise, squares, information, pull = 0.4, [], np.zeros((5, 5)), np.zeros(5)
    for seed in range(40):
        window = solved(seed, (0.0, 0.0), noise)
        one, by_one = (each / noise ** 2
                       for each in marginal(window.problem, window.state))
        squares.append(by_one @ np.linalg.solve(one, by_one))
        information, pull = information + one, pull + by_one
    assert pull @ np.linalg.solve(information, pull) < 18.0, 'of five, exceeded once in 300'
    assert 1.25 < np.mean(squares) < 7.5, 'a chi square of five has mean five; the loss is careful'


def test_short_tracks_are_not_asked():
    """However wrong they are, they change nothing."""
    window = solved(3, (0.0, 0.005), 0.3)
    short = np.arange(window.problem.mask.shape[1]) % 2 == 0
    mask, seen = window.problem.mask.copy(), window.problem.seen.copy()
    mask[LEAST_VIEWS - 1:, short] = False
    seen[:, :, short] *= 1.1
    long = window.problem.of_points(~short)
    for told, alone in zip(
            marginal(window.problem._replace(mask=mask, seen=seen), window.state),
            marginal(long, window.state.of_points(~short)), strict=True):
        np.testing.assert_allclose(told, alone)


def test_each_answer_adds_to_what_is_known():
    window = solved(3, (0.0, 0.005), 0.3)
    first = IntrinsicsFilter().told(window.problem, window.state, window.noise, range(8))
    second = first.told(window.problem, window.state, window.noise, range(8, 16))
    assert 0.0 < first.errors[1] < 0.005
    assert (first.asked, second.asked) == (7, 15)
    variances = [np.linalg.inv(lens.information)[1, 1] for lens in (first, second)]
    assert EXPECTED[1] ** 2 > variances[0] > variances[1]


def test_frames_that_were_asked_before_do_not_count_again():
    window = solved(3, (0.0, 0.005), 0.3)
    fresh, half = (IntrinsicsFilter(asked=asked).told(window.problem, window.state, window.noise, range(8))
                   for asked in (-1, 3))
    assert (IntrinsicsFilter(asked=3).new_in(range(8)), half.new_in(range(8))) == (0.5, 0.0)
    np.testing.assert_allclose(half.information - IntrinsicsFilter().information,
                               0.5 * (fresh.information - IntrinsicsFilter().information))


def test_frames_far_apart_say_more_than_successive_ones():
    window = solved(3, (0.0, 0.005), 0.3)
    near, far = (IntrinsicsFilter().told(window.problem, window.state, window.noise, range(0, 8 * gap, gap))
                 for gap in (1, 4))
    assert np.linalg.eigvalsh(far.information - near.information).min() > 0.0
    assert abs(far.errors[1] - 0.005) < abs(near.errors[1] - 0.005)
    independent, _ = marginal(window.problem, window.state)
    assert np.linalg.eigvalsh(
        independent / window.noise ** 2 + IntrinsicsFilter().information - far.information).min() > 0.0


def test_a_window_without_parallax_tells_nothing_of_the_focal_length():
    cloud = PointCloud(0, noise=0.3)
    views = [cloud.encode(index, np.eye(4)).payload for index in range(8)]
    window = solve(build_track_table(views, 0, IntrinsicsFilter()), Initialiser(CAMERA.fx, 0), None, HistoryFrames())
    lens = IntrinsicsFilter().told(window.problem, window.state, window.noise, range(8))
    assert np.isfinite(lens.errors).all()
    assert (np.abs(lens.errors) < EXPECTED).all()


def test_a_lens_without_errors_changes_no_bit_and_the_rim_of_a_fisheye_stays_near():
    points = np.random.default_rng(0).normal(size=(50, 2))
    assert IntrinsicsFilter().straighten(points).tobytes() == points.tobytes()
    far = np.array([[5.6, 0.0]])
    assert np.allclose(IntrinsicsFilter(np.array([0.0, 0.01, 0.0, 0.0, 0.0])).straighten(far), far, rtol=0.021)


class Watched(GeometricBackbone):
    """Remembers what every estimate leaves to the next."""

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


def calibrated(k1: float, readout_s: float = 0.0, cx: float = 0.0) -> Camera:
    """Return what somebody says of the sequence's camera: its axis is off by `cx` [px].

    It has no distortion.
    """
    return replace(SEQUENCE.camera, cx=SEQUENCE.camera.cx + cx, distortion_model='plumb_bob',
                   distortion=(k1, 0.0, 0.0, 0.0), readout_s=readout_s)


@pytest.mark.parametrize(('k1', 'cx', 'share'), [(K1, 0.0, 0.6), (0.0, 2.0, 0.9)])
def test_a_wrong_calibration_is_found_out(k1, cx, share):
    """By as much as what is left of the error tells."""
    errors = {}
    for readout_s in (0.0, 1e-9):
        backbone = Watched()
        result = run(frames(calibrated(k1, readout_s, cx)), Survival(), backbone)
        errors[readout_s] = metrics.absolute_trajectory_error(
            result.trajectory, SEQUENCE.ground_truth().trajectory).rmse
        found = backbone.memories[-1].lens
        if readout_s:
            assert found.asked == -1, 'what a rolling shutter does would be laid to the lens'
            assert all(update.intrinsics is None for update in result.updates)
        else:
            axis = -cx / SEQUENCE.camera.fx
            assert abs(found.errors[1] + k1) < 0.3 * K1
            assert abs(found.errors[0]) < 0.005
            assert abs(found.errors[3] - axis) < 0.0025
    assert errors[0.0] < share * errors[1e-9]


def test_the_focal_length_is_told_once_it_is_known():
    true = SEQUENCE.camera
    seen = [update.intrinsics for update in run(frames(true.miscalibrated(0.01, 0.0)),
                                                Survival()).updates]
    assert all(K is None for K in seen[:8])
    assert np.allclose(seen[-1], true.matrix, rtol=0.004)


def test_intrinsics_put_straightened_points_where_the_calibration_saw_them():
    lens, points = IntrinsicsFilter(np.array([0.01, 0.0, 0.0, 0.002, -0.001])), np.array([[0.3, -0.2]])
    ray = np.append(lens.straighten(points), 1.0)
    np.testing.assert_allclose(lens.intrinsics(CAMERA) @ ray,
                               CAMERA.matrix @ np.append(points, 1.0), rtol=1e-12)


def test_a_right_calibration_is_left_alone():
    backbone = Watched()
    run(frames(SEQUENCE.camera), Survival(), backbone)
    lens = backbone.memories[-1].lens
    assert lens.asked > 0
    assert abs(lens.errors[1]) < 0.2 * K1


def test_a_start_from_nothing_keeps_the_lens_and_nothing_else():
    lens = IntrinsicsFilter(np.array([0.001, 0.002, 0.0, 0.0, 0.0]), asked=7)
    memory = KeyframeHistory(measured=True, windows=20, lens=lens)
    previous = WindowPrior(np.eye(4)[None], np.eye(4), None, memory)
    kept = history_of(previous)
    assert kept.lens is lens
    assert (kept.windows, kept.certain, kept.views) == (0, False, ())
    assert history_of(replace(previous, points=Points(*np.zeros((3, 0))))) is memory
    assert history_of(None).lens.asked == -1


def test_darkness_does_not_forget_the_lens():
    backbone = Watched()
    run(frames(calibrated(K1), range(100, 115)), Survival(), backbone)
    windows = [memory.windows for memory in backbone.memories]
    anew = next(index for index in range(1, len(windows)) if windows[index] < windows[index - 1])
    before, after = (backbone.memories[index].lens for index in (anew - 1, anew))
    assert before.errors[1] < -0.3 * K1
    assert np.array_equal(before.errors, after.errors)
