# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TrackSearch: points are tracked through motions that the last image did not show."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from epipolar import epipolar_errors

from kfvo_ros import geometry
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.tracking import klt, motion_field, search
from kfvo_ros.tracking.search import TrackSearch, whole_image_shift
from kfvo_ros.tracking.tracker import Tracker, common_pixels

HEIGHT, WIDTH = 240, 320
SIZE = np.array([WIDTH, HEIGHT])


@pytest.fixture(scope='module')
def scene() -> np.ndarray:
    return SyntheticSequence(0, 'smooth', 1).frame(0).image


def cut(image: np.ndarray, x: int, y: int) -> np.ndarray:
    return image[y:y + HEIGHT, x:x + WIDTH].copy()


def corners(image: np.ndarray) -> np.ndarray:
    return cv2.goodFeaturesToTrack(image, 200, 0.01, 8.0)[:, 0].astype(np.float64)


def uniform_field(x: float, y: float) -> motion_field.MotionField:
    """Return the field of a last image that moved by (x, y) [px]."""
    grid = np.random.default_rng(0).random((50, 2)) * SIZE
    return motion_field.fit(grid, np.tile([x, y], (50, 1)), SIZE)


@pytest.mark.parametrize('x, y', [(0, 0), (57, 0), (-90, 31), (9, -44)])
def test_whole_image_shift_is_known_to_a_few_pixels(scene, x, y):
    last, image = cut(scene, 140, 90), cut(scene, 140 - x, 90 - y)
    assert whole_image_shift(last, image, None) == pytest.approx((x, y), abs=6.0)


@pytest.mark.parametrize('field', [None, uniform_field(0, 0), uniform_field(-60, 20)])
def test_a_turn_that_starts_or_reverses_is_tracked(scene, field):
    last, image = cut(scene, 140, 90), cut(scene, 50, 90)
    points = corners(last)
    visible = points[:, 0] + 90.0 < WIDTH - 20.0
    after, found, _ = TrackSearch(field).match(last, image, points)
    assert found[visible].mean() > 0.9
    assert np.abs(after - points - (90.0, 0.0))[found & visible].max() < 0.5


def test_whole_image_shift_is_relative_to_the_field(scene):
    last, image = cut(scene, 140, 90), cut(scene, 50, 90)
    assert whole_image_shift(last, image, uniform_field(70, 0)) == pytest.approx((20, 0), abs=6.0)


@pytest.mark.parametrize('shift, starts', [(3.0, [0.0, 0.0]), (10.0, [10.0, 0.0])])
def test_the_error_of_the_last_shift_corrects_the_next(scene, monkeypatch, shift, starts):
    """The correlation is off by the same amount in each image of a forward motion."""
    image, first_starts, track_points = cut(scene, 140, 90), [], klt.track_points

    def recording(last, image, points, start):
        first_starts.append(np.abs(start - points).max())
        return track_points(last, image, points, start)

    monkeypatch.setattr(search, 'whole_image_shift', lambda *_: np.array([shift, 0.0]))
    monkeypatch.setattr(klt, 'track_points', recording)
    track_search, points = TrackSearch(uniform_field(0, 0)), corners(image)
    for _ in range(2):
        after, found, _ = track_search.match(image, image, points)
        track_search.update(points[found], after[found], SIZE)
    assert first_starts == pytest.approx(starts, abs=0.1)


def test_the_right_instance_of_a_repeated_texture_is_found():
    """Tiles repeat every 40 px; only the shade across them distinguishes them."""
    rng = np.random.default_rng(1)
    tile = cv2.GaussianBlur(rng.integers(0, 120, (40, 40), dtype=np.uint8), (0, 0), 1.5)
    wall = np.tile(tile, (6, 12)).astype(np.float64)
    shade = cv2.GaussianBlur(rng.random(wall.shape), (0, 0), 12.0)
    wall += 130.0 * (shade - shade.min()) / np.ptp(shade)
    wall = np.clip(wall, 0.0, 255.0).astype(np.uint8)
    last, image = wall[:, 100:420].copy(), wall[:, 60:380].copy()
    points = corners(last)
    points = points[(points[:, 0] < 260.0)]
    after, found, _ = TrackSearch(uniform_field(0, 0)).match(last, image, points)
    right = np.abs(after - points - (40.0, 0.0)).max(axis=1) < 0.5
    assert found.mean() > 0.8 and right[found].mean() > 0.95


def test_a_wrong_shift_in_front_of_a_repeated_texture_is_rejected(scene, monkeypatch):
    """Half of the image repeats, like a facade, and looks the same two windows farther on."""
    rng = np.random.default_rng(1)
    window = cv2.GaussianBlur(rng.integers(0, 255, (30, 30), dtype=np.uint8), (0, 0), 1.5)
    wall = np.hstack([np.tile(window, (8, 10)), cut(scene, 140, 90)])
    last, image = wall[:, 130:450].copy(), wall[:, 100:420].copy()
    points = corners(last)
    points = points[(points[:, 0] > 40.0) & (points[:, 0] < 250.0)]
    monkeypatch.setattr(search, 'whole_image_shift', lambda *_: np.array([-60.0, 0.0]))
    after, found, _ = TrackSearch(uniform_field(30, 0)).match(last, image, points)
    right = np.abs(after - points - (30.0, 0.0)).max(axis=1) < 0.5
    assert found.mean() > 0.8 and right[found].mean() > 0.95


def test_a_fast_turn_in_front_of_a_tiled_wall_finds_the_right_tiles():
    """12 deg per frame; correct tracks agree with the true motion."""
    room = SyntheticSequence(51, 'mixed')
    camera, poses = room.camera, room.ground_truth().trajectory.poses
    tracker = Tracker(camera)
    tracks = [tracker.track(room.frame(index).image) for index in range(30, 38)]
    motions = geometry.relative(poses[31:38], poses[30:37])
    errors = [epipolar_errors(camera, *common_pixels(*pair), motion)
              for pair, motion in zip(itertools.pairwise(tracks), motions, strict=True)]
    assert max(np.mean(each > 2.0) for each in errors) < 0.1


def test_half_of_the_tracks_survive_a_fast_turn_in_a_room():
    """The turn of up to 15 deg per frame starts abruptly; there are 400 tracks."""
    tracker, room = Tracker(), SyntheticSequence(9, 'mixed')
    tracks = [tracker.track(room.frame(index).image) for index in range(44, 56)]
    survivors = [len(common_pixels(before, after)[0])
                 for before, after in itertools.pairwise(tracks)]
    assert min(survivors) > 190


def test_images_without_texture_give_no_tracks_and_no_error():
    flat = np.full((HEIGHT, WIDTH), 90, dtype=np.uint8)
    _, found, _ = TrackSearch().match(flat, flat, np.array([[50.0, 60.0]]))
    assert found.shape == (1,) and not found.any()
    assert np.isfinite(whole_image_shift(flat, flat, None)).all()
