# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tracker on rendered images with known motion, and on images without texture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from odometry_scenes import certain_tracks, frames_of

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.tracking import klt
from kfvo_ros.tracking.corners import MIN_DISTANCE
from kfvo_ros.tracking.tracker import (
    BORDER,
    FEATURES,
    MAX_SKIPPED,
    Tracker,
    Tracks,
    common_pixels,
    ids_in,
    match_ids,
)

SHAPE = (240, 320)


@pytest.fixture(scope='module')
def images() -> list[np.ndarray]:
    return [frame.image for frame in frames_of(0, 30)]


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8)


def test_ids_persist_and_increase(images):
    tracker = Tracker()
    before, largest = Tracks(), -1
    for index, image in enumerate(images):
        tracks = tracker.track(image)
        if index == 8:
            assert (tracks.ids < 300).sum() > 20  # some tracks are long
        assert tracks.ids.dtype == np.int64
        assert tracks.pixels.shape == (len(tracks), 2)
        assert (np.diff(tracks.ids) > 0).all()
        new = tracks.ids[~np.isin(tracks.ids, before.ids)]
        assert (new > largest).all()  # ids are never reused
        largest = max(largest, int(tracks.ids.max()))
        inside = np.minimum(tracks.pixels, np.array(image.shape[::-1]) - tracks.pixels)
        assert inside.min() > BORDER - 2.0  # the bias correction may cross the border
        before = tracks
    assert len(tracks) > 80


def test_tracks_agree_with_rendered_depth_and_motion():
    sequence = SyntheticSequence(3, 'smooth', 5, 320, 240)
    camera, poses = sequence.camera, sequence.ground_truth().trajectory.poses
    tracker = Tracker()
    tracks = [tracker.track(sequence.frame(index).image) for index in range(5)]
    first, last = common_pixels(tracks[0], tracks[4])
    x, y = first.round().astype(int).T
    depth = sequence.depth(0)[y, x]
    rays = np.column_stack([camera.undistort(first), np.ones(len(first))])
    T_last_first = geometry.relative(poses[4], poses[0])
    points = (rays * depth[:, None]) @ T_last_first[:3, :3].T + T_last_first[:3, 3]
    expected = camera.distort(points[:, :2] / points[:, 2:])
    errors = np.linalg.norm(last - expected, axis=1)
    assert len(first) > 50
    assert np.linalg.norm(last - first, axis=1).mean() > 5.0
    assert np.median(errors) < 0.5
    assert np.percentile(errors, 85) < 2.0  # a rounded pixel may have the depth of the background


def true_error(sequence: SyntheticSequence, gap: int) -> float:
    """Return the mean over frames of the median track error after `gap` frames [px]."""
    camera, poses = sequence.camera, sequence.ground_truth().trajectory.poses
    tracker = Tracker(camera)
    tracks = [tracker.track(frame.image) for frame in sequence]
    errors = []
    for index in range(len(tracks) - gap):
        first, last = common_pixels(tracks[index], tracks[index + gap])
        column, row = first.round().astype(int).T
        rays = np.column_stack([camera.undistort(first), np.ones(len(first))])
        points = rays * sequence.depth(index)[row, column, None]
        T_last_first = geometry.relative(poses[index + gap], poses[index])
        points = points @ T_last_first[:3, :3].T + T_last_first[:3, 3]
        expected = camera.distort(points[:, :2] / points[:, 2:])
        errors.append(np.median(np.linalg.norm(last - expected, axis=1)))
    return float(np.mean(errors))


def test_narrow_patches_are_more_accurate(monkeypatch):
    """Wide patches average over surfaces that move differently."""
    sequence = SyntheticSequence(0, 'smooth', 16)
    narrow = true_error(sequence, 4)
    monkeypatch.setitem(klt.REFINEMENT, 'winSize', klt.SEARCH['winSize'])
    assert narrow < 0.8 * true_error(sequence, 4)


def test_corners_are_many_and_spread():
    grey = SyntheticSequence(0, 'smooth', 1).frame(0).image
    tracks = Tracker().track(grey)
    assert FEATURES // 3 < len(tracks) <= FEATURES
    distance = np.linalg.norm(tracks.pixels[:, None] - tracks.pixels, axis=2)
    assert (distance[np.triu_indices(len(tracks), 1)] > MIN_DISTANCE).all()
    quadrants = (tracks.pixels > (320, 240)) @ [1, 2]
    assert np.bincount(quadrants, minlength=4).min() > 0.1 * len(tracks)


def test_the_number_of_features_is_respected(images):
    assert 35 <= len(Tracker(features=40).track(images[0])) <= 40


def test_seeds_beyond_32_bits_are_accepted(images):
    tracker = Tracker(seed=2 ** 40)
    for image in images[:3]:
        assert len(tracker.track(image)) > 50


def test_equal_images_give_equal_bytes(images):
    first, second = Tracker(), Tracker()
    for image in images[:8]:
        a, b = first.track(image), second.track(image.copy())
        assert a.ids.tobytes() == b.ids.tobytes()
        assert a.pixels.tobytes() == b.pixels.tobytes()


def test_images_and_earlier_tracks_are_not_modified(images):
    tracker = Tracker()
    image = images[0].copy()
    first = tracker.track(image)
    copy = first.pixels.copy()
    for later in images[1:5]:
        tracker.track(later)
    assert np.array_equal(image, images[0])
    assert np.array_equal(first.pixels, copy)


def test_tracks_on_a_moving_object_are_rejected():
    """A patch that jumps up and down violates the epipolar geometry."""
    sequence = SyntheticSequence(0, 'smooth', 5, 320, 240)
    tracker, patch = Tracker(sequence.camera), noise(7)[:60, :60]
    tracks = []
    for index in range(5):
        image = sequence.frame(index).image.copy()
        row = 90 + 9 * (index % 2)
        image[row:row + 60, 120:180] = patch
        tracks.append(tracker.track(image))
    first, second = common_pixels(tracks[3], tracks[4])
    kept_on_patch = (np.abs(second - first - (0, -9)).max(axis=1) < 0.5) & (
        np.abs(first - (150, 90 + 9 + 30)) < 24).all(axis=1)
    on_patch = (np.abs(tracks[3].pixels - (150, 90 + 9 + 30)) < 24).all(axis=1)
    assert on_patch.sum() > 5
    assert kept_on_patch.sum() < 0.5 * on_patch.sum()
    assert len(first) > 50


@pytest.mark.parametrize('length', range(1, MAX_SKIPPED + 1))
@pytest.mark.parametrize('value', [0, 255])
def test_tracks_survive_skipped_frames(images, length, value):
    tracker = Tracker()
    for image in images[:4]:
        before = tracker.track(image)
    for _ in range(length):
        assert len(tracker.track(np.full(SHAPE, value, dtype=np.uint8))) == 0
    after = tracker.track(images[5])
    assert len(common_pixels(before, after)[0]) > 0.4 * len(before)


def test_tracking_restarts_after_long_darkness(images):
    tracker = Tracker()
    before = tracker.track(images[0])
    for _ in range(MAX_SKIPPED + 2):
        assert len(tracker.track(np.zeros(SHAPE, dtype=np.uint8))) == 0
    again = tracker.track(images[0])
    assert len(again) > 50
    assert not np.isin(again.ids, before.ids).any()
    assert len(common_pixels(again, tracker.track(images[1]))[0]) > 0.5 * len(again)


@pytest.mark.parametrize('image', [
    np.zeros(SHAPE, np.uint8), np.full(SHAPE, 255, np.uint8), np.full(SHAPE, 90, np.uint8)])
def test_constant_images_have_no_corners(image):
    tracker = Tracker()
    for _ in range(6):
        assert len(tracker.track(image)) == 0


def test_a_gradient_has_few_corners():
    slope = np.tile(np.linspace(0, 255, SHAPE[1]).astype(np.uint8), (SHAPE[0], 1))
    tracker = Tracker()
    for _ in range(3):
        tracks = tracker.track(slope)
        assert len(tracks) < 10
        assert np.isfinite(tracks.pixels).all()


def test_a_repeated_image_has_no_flow(images):
    tracker = Tracker()
    first = tracker.track(images[0])
    for _ in range(5):
        again = tracker.track(images[0])
    before, after = common_pixels(first, again)
    assert len(before) > 0.9 * len(first)
    assert np.abs(after - before).max() < 0.1


def test_unrelated_noise_images_raise_no_error():
    tracker = Tracker()
    for seed in range(12):
        tracks = tracker.track(noise(seed))
        assert np.isfinite(tracks.pixels).all()
    assert len(tracks) < FEATURES + 1


@pytest.mark.parametrize('shape', [(48, 64), (24, 32), (12, 16), (9, 9), (1, 1), (5, 300),
                                   (1, 300_000), (300_000, 1)])
def test_tiny_and_extreme_images_raise_no_error(shape):
    tracker = Tracker()
    for seed in range(6):
        image = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
        assert np.isfinite(tracker.track(image).pixels).all()


def test_tracking_restarts_when_the_image_size_changes(images):
    tracker = Tracker()
    before = tracker.track(images[0])
    small = images[1][:120, :160].copy()
    for _ in range(MAX_SKIPPED + 1):
        after = tracker.track(small)
    assert len(after) > 10
    assert not np.isin(after.ids, before.ids).any()


def survivors(tracker: Tracker, images: list[np.ndarray]) -> int:
    """Return how many tracks of the first image survive to the last."""
    tracks = [tracker.track(image) for image in images]
    return len(common_pixels(tracks[0], tracks[-1])[0])


def test_tracks_survive_behind_a_distorting_lens():
    """The lens bends epipolar lines; the outlier test must undistort the points."""
    sequence = SyntheticSequence(0, 'smooth', 6, 320, 240)
    pinhole = sequence.camera
    camera = Camera(320, 240, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, 'plumb_bob',
                    (-0.28, 0.07, 0.0, 0.0))
    grid = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 2)
    source = pinhole.distort(camera.undistort(grid)).astype(np.float32).reshape(240, 320, 2)
    straight = [frame.image for frame in sequence]
    bent = [cv2.remap(image, source, None, cv2.INTER_LINEAR) for image in straight]
    assert survivors(Tracker(camera), bent) > 0.7 * survivors(Tracker(pinhole), straight)


def test_a_steady_turn_is_predicted():
    """Fine grain has no texture at the pyramid level that a search for a fast turn needs."""
    rng = np.random.default_rng(0)
    grain = cv2.GaussianBlur(rng.integers(0, 256, (240, 1200), dtype=np.uint8), (0, 0), 1.5)
    columns = np.cumsum([0, 5, 13, 22, 31, 40, 50, 60, 70, 80, 90])
    tracker = Tracker()
    tracks = [tracker.track(grain[:, column:column + 320].copy()) for column in columns]
    before, after = common_pixels(tracks[-2], tracks[-1])
    assert len(before) > 0.4 * len(tracks[-2])
    assert np.median(np.abs(after - before + (90.0, 0.0))) < 0.05


def test_a_turn_that_stops_keeps_its_tracks():
    """The prediction continues the turn and is wrong."""
    wide = SyntheticSequence(0, 'smooth', 1).frame(0).image
    columns = [0, 30, 60, 90, 120, 120, 120]
    tracker = Tracker()
    tracks = [tracker.track(wide[100:340, column:column + 320].copy()) for column in columns]
    before, after = common_pixels(tracks[4], tracks[5])
    assert len(before) > 0.9 * len(tracks[4])
    assert np.abs(after - before).max() < 0.1


def test_select_and_common_pixels():
    a = certain_tracks(np.array([1, 4, 6, 9]), np.arange(8.0).reshape(4, 2))
    b = certain_tracks(np.array([2, 4, 9]), 10.0 + np.arange(6.0).reshape(3, 2))
    in_a, in_b = common_pixels(a, b)
    assert np.array_equal(in_a, a.pixels[[1, 3]])
    assert np.array_equal(in_b, b.pixels[[1, 2]])
    assert a.select(np.array([True, False, False, True])).ids.tolist() == [1, 9]
    assert len(common_pixels(a, Tracks())[0]) == 0


@pytest.mark.parametrize('seed', range(5))
def test_match_ids_equals_set_intersection(seed):
    rng = np.random.default_rng(seed)
    a, b = (np.flatnonzero(rng.random(60) < share) + 7 for share in (0.3, 0.7))
    in_a, in_b = match_ids(a, b)
    assert np.array_equal(a[in_a], b[in_b])
    assert set(a[in_a]) == set(a) & set(b)
    assert np.array_equal(ids_in(a, b), np.isin(a, b))


def test_disjoint_or_empty_ids_have_no_match():
    some, none = np.array([3, 5]), np.zeros(0, dtype=np.int64)
    for a, b in ((some, none), (none, some), (none, none), (some, some + 10), (some + 10, some)):
        assert all(len(indices) == 0 for indices in match_ids(a, b))
        assert len(ids_in(a, b)) == len(a) and not ids_in(a, b).any()
