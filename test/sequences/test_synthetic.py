# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rendered sequences: fixed bytes, exact geometry, and difficulty."""

import json
import tracemalloc
import zlib

import numpy as np
import pytest

from kfvo_ros import geometry, run
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence, parse_synthetic
from kfvo_ros.tracking import search
from kfvo_ros.tracking.tracker import Tracker, common_pixels

CHECKSUMS = {(0, 'smooth'): 0x8502720a, (1, 'fast'): 0xaf7b44c2, (7, 'mixed'): 0x5b5b70fb,
             (2, 'street'): 0x6becd4e2}
"""CRC-32 of frames 0, 7 and 60 at 320x240: a change of one byte changes every result."""


@pytest.mark.parametrize(('seed', 'style'), list(CHECKSUMS))
def test_bytes_of_a_seed_are_fixed(seed, style):
    sequence = SyntheticSequence(seed, style, 61, 320, 240)
    checksum = 0
    for index in (0, 7, 60):
        checksum = zlib.crc32(sequence.frame(index).image.tobytes(), checksum)
    assert checksum == CHECKSUMS[seed, style]


def test_frames_do_not_depend_on_the_order_or_the_length():
    long, short = (SyntheticSequence(3, 'mixed', count, 160, 120) for count in (40, 12))
    for index in (11, 0, 5):
        assert np.array_equal(long.frame(index).image, short.frame(index).image)
    assert [frame.stamp_ns for frame in short] == [long.frame(i).stamp_ns for i in range(12)]
    np.testing.assert_array_equal(long.ground_truth().trajectory.poses[:12],
                                  short.ground_truth().trajectory.poses)


@pytest.mark.parametrize(('style', 'rate'), [('smooth', 30), ('street', 10)])
def test_frame_rate_and_ground_truth_stamps(style, rate):
    sequence = SyntheticSequence(0, style, 31, 64, 48)
    stamps = np.array([frame.stamp_ns for frame in sequence])
    np.testing.assert_array_equal(stamps, sequence.ground_truth().trajectory.stamps_ns)
    assert stamps[rate] - stamps[0] == 1_000_000_000
    assert sequence.length == 31 and sequence.ground_truth().frame == 'camera'


def test_depth_and_pose_predict_the_reprojection():
    """A point has the same brightness in two frames, up to noise and gain."""
    sequence = SyntheticSequence(1, 'smooth', 6, 320, 240)
    first, second = sequence.frame(0), sequence.frame(5)
    rows, columns = np.mgrid[20:220:10, 20:300:10].reshape(2, -1)
    pixels = np.column_stack([columns, rows]).astype(float)
    rays = np.column_stack([sequence.camera.undistort(pixels), np.ones(len(pixels))])
    poses = sequence.ground_truth().trajectory.poses
    T_second_first = geometry.relative(poses[5], poses[0])
    points = rays * sequence.depth(0)[rows, columns, None] @ T_second_first[:3, :3].T
    points += T_second_first[:3, 3]
    projected = sequence.camera.distort(points[:, :2] / points[:, 2:])
    inside = ((projected > 2) & (projected < (317, 237))).all(axis=1)
    x, y = projected[inside].round().astype(int).T
    visible = np.abs(sequence.depth(5)[y, x] - points[inside, 2]) < 0.05
    assert visible.sum() > 200
    difference = (first.image[rows[inside], columns[inside]].astype(float)
                  - second.image[y, x])[visible]
    assert np.median(np.abs(difference - np.median(difference))) < 4.0


def test_memory_does_not_grow_with_length():
    sequence = SyntheticSequence(0, 'fast', 200, 64, 48)
    frames = iter(sequence)
    for _ in range(20):
        next(frames)
    tracemalloc.start()
    for _ in frames:
        pass
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2_000_000


@pytest.mark.parametrize('text', ['synthetic:', 'synthetic:x', 'synthetic:1:slow', 'synthetic:-1',
                                  'synthetic:1:smooth:2', 'synthetic:99999999999'])
def test_malformed_names_are_rejected(text):
    with pytest.raises(KfvoError, match='expected'):
        parse_synthetic(text)


def test_names_are_parsed():
    assert parse_synthetic('synthetic:7').name == 'synthetic:7:mixed'
    assert parse_synthetic('synthetic:7:fast').name == 'synthetic:7:fast'


def test_pure_rotation_is_limited():
    """A rotation without translation is 40 degrees at most."""
    for seed in range(10):
        poses = SyntheticSequence(seed, 'mixed').ground_truth().trajectory.poses
        resting = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) < 5e-4
        turn = geometry.rotation_angle(geometry.relative(poses[:-1], poses[1:])[:, :3, :3])
        turned = 0.0
        for is_resting, angle in zip(resting, turn, strict=True):
            turned = turned + angle if is_resting else 0.0
            assert np.degrees(turned) <= 40.0


@pytest.mark.parametrize(('style', 'min_lifetime'), [
    ('smooth', 4.0), ('fast', 4.0), ('mixed', 4.0), ('street', 3.0)])
def test_difficulty_of_seeds_0_to_9(style, min_lifetime):
    """Mean flow of 5 to 25 px per frame and track lifetimes of 4 to 15 frames.

    In a street, at 10 Hz, the lower limit is 3.
    """
    flows, lifetimes = zip(*(_measure(seed, style) for seed in range(10)), strict=True)
    assert 5.0 < np.mean(flows) < 25.0, flows
    assert min_lifetime < np.mean(lifetimes) < 15.0, lifetimes


def test_street_motion_is_that_of_a_car():
    """The camera looks ahead, stops and starts, and turns at up to 60 degrees per second."""
    for seed in range(10):
        sequence = SyntheticSequence(seed, 'street')
        poses = sequence.ground_truth().trajectory.poses
        steps = np.diff(poses[:, :3, 3], axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        assert 80.0 < lengths.sum() < 200.0 and lengths.max() < 1.5
        moving = lengths > 0.1
        ahead = (steps * poses[:-1, :3, 2]).sum(axis=1)[moving] / lengths[moving]
        assert ahead.min() > np.cos(np.radians(6.0))
        turn = geometry.rotation_angle(geometry.relative(poses[:-1], poses[1:])[:, :3, :3])
        assert np.degrees(turn).max() < 6.0
        assert abs(poses[:, 2, 3] - 1.65).max() < 0.01
        assert sequence.depth(0).min() > 1.0 and 20.0 < sequence.depth(0).max() < 500.0


def test_mixed_seeds_defeat_a_search_without_prediction(tmp_path, monkeypatch):
    """A search for tracks at their last position gives an ATE over 3 % of the path.

    Keyframes are 50 px of flow apart. Tracks survive where the search starts from the last
    motion or the shift of the whole image.
    """
    monkeypatch.setattr(search.TrackSearch, '_predictions', lambda *_: iter([]))
    monkeypatch.setattr(search, 'CERTAIN_FROM', 0.0)
    failed = 0
    for seed in (5, 7):
        assert run.main([f'synthetic:{seed}:mixed', '--keyframes', 'optical_flow', '--output',
                         str(tmp_path / str(seed))]) == 0
        summary = json.loads((tmp_path / str(seed) / 'summary.json').read_text())
        failed += summary['ate_rmse_m'] > 0.03 * summary['path_length_m']
    assert failed == 2


def _measure(seed: int, style: str) -> tuple[float, float]:
    """Return the mean flow [px/frame] at 640x480 and the mean lifetime of ended tracks."""
    tracker, last, flows, born, lifetimes = Tracker(), None, [], {}, []
    for index, frame in enumerate(SyntheticSequence(seed, style, 40)):
        tracks = tracker.track(frame.image)
        if last is not None:
            before, after = common_pixels(last, tracks)
            flows.append(np.linalg.norm(after - before, axis=1).mean())
            lifetimes += [index - born[track] for track in np.setdiff1d(last.ids, tracks.ids)]
        born.update((track, born.get(track, index)) for track in tracks.ids)
        last = tracks
    return float(np.mean(flows)), float(np.mean(lifetimes))
