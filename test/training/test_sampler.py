# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From names of sequences to episodes: drives on disk, workers, what can be refused."""

from __future__ import annotations

import gc
import json
import os
import weakref
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from sequence_writers import DATASETS, make_image, make_poses, write_camera_info

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.odometry.options import SequenceOptions
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.training import sampler
from kfvo_ros.training.augmentation import Augmentation
from kfvo_ros.training.encoded_sequence import (
    FILE_KEY,
    encode_sequence,
    read_encoded_sequence,
    write_encoded_sequence,
)
from kfvo_ros.training.env import OBSERVATION, PRIVILEGED
from kfvo_ros.training.sampler import EnvironmentConfig, make_environment
from kfvo_ros.training.sequence_cache import EncodedSequenceCache

FRAMES = 30
READING = SequenceOptions(stop=FRAMES)
SEQUENCES = ('synthetic:2:smooth', 'synthetic:4:smooth', 'synthetic:6:smooth')


@pytest.fixture(scope='module')
def backbone() -> GeometricBackbone:
    return GeometricBackbone()


@pytest.fixture(scope='module')
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp('cache')


def lesson(cache: Path, **changes) -> EnvironmentConfig:
    return EnvironmentConfig(SEQUENCES, READING, augmentation=Augmentation(frames=FRAMES, max_stride=1),
                             cache=cache, **{'variants': 1} | changes)


def run(lesson: EnvironmentConfig, workers: int, seed: int = 0, steps: int = 40):
    environment = make_environment(lesson, 3, workers, seed)
    try:
        told = [environment.reset()[OBSERVATION]]
        earned, rng = [], np.random.default_rng(0)
        for _ in range(steps):
            observations, rewards, _, _ = environment.step(rng.integers(0, 2, 3))
            told.append(observations[OBSERVATION])
            earned.append(rewards)
        assert observations[PRIVILEGED].shape[0] == environment.num_envs == 3
        return np.array(told), np.array(earned)
    finally:
        environment.close()


def test_a_drive_comes_back_from_its_file_as_it_was(backbone, tmp_path):
    drive = encode_sequence(SyntheticSequence(2, 'smooth', 8, 160, 120), backbone)
    write_encoded_sequence(tmp_path / 'drive.safetensors', drive)
    back = read_encoded_sequence(tmp_path / 'drive.safetensors')
    assert back.name == drive.name and len(back) == len(drive) == 8
    np.testing.assert_array_equal(back.T_truth_camera, drive.T_truth_camera)
    for ours, theirs in zip(back.encoded, drive.encoded, strict=True):
        assert ours.stamp_ns == theirs.stamp_ns and ours.payload.index == theirs.payload.index
        np.testing.assert_array_equal(ours.descriptor, theirs.descriptor)
        for a, b in ((ours.tracks, theirs.tracks), (ours.payload.tracks, theirs.payload.tracks)):
            np.testing.assert_array_equal(a.ids, b.ids)
            np.testing.assert_array_equal(a.pixels, b.pixels)
            np.testing.assert_array_equal(a.uncertainty, b.uncertainty)
        np.testing.assert_array_equal(ours.payload.points, theirs.payload.points)
    assert back.frames[0].camera == drive.frames[0].camera
    assert drive.encoded[-1].tracks.uncertainty.any()


@pytest.mark.parametrize('damage', [b'', b'nonsense', b'\x00' * 100])
def test_a_damaged_file_is_as_good_as_none(backbone, tmp_path, damage):
    path = tmp_path / 'drive.safetensors'
    path.write_bytes(damage)
    assert read_encoded_sequence(path) is None


@pytest.fixture(scope='module')
def drive_file(backbone, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp('drive') / 'drive.safetensors'
    write_encoded_sequence(path, encode_sequence(SyntheticSequence(2, 'smooth', 8, 160, 120), backbone))
    return path


@pytest.mark.parametrize('camera', [{'distortion_model': 5}, {'fx': -1}, {'fx': 10 ** 400}])
def test_a_drive_of_an_impossible_camera_is_as_good_as_none(drive_file, tmp_path, camera):
    path = tmp_path / 'drive.safetensors'
    with safe_open(drive_file, 'np') as file:
        head = json.loads(file.metadata()[FILE_KEY])
    save_file(load_file(drive_file), path, {FILE_KEY: json.dumps(head)})
    assert read_encoded_sequence(path) is not None
    head['camera'] |= camera
    save_file(load_file(drive_file), path, {FILE_KEY: json.dumps(head)})
    assert read_encoded_sequence(path) is None


@pytest.mark.parametrize(('name', 'change'), [
    ('T_truth_camera', lambda array: array[:3]),
    ('T_truth_camera', lambda array: array[:, :3]),
    ('T_truth_camera', lambda array: array * np.nan),
    ('descriptors', lambda array: array[:, :-1]),
    ('descriptors', lambda array: array * np.inf),
    ('counts', lambda array: array + 1),
    ('ids', lambda array: array[1:]),
    ('pixels', lambda array: array * np.nan)])
def test_a_drive_whose_arrays_do_not_fit_is_as_good_as_none(drive_file, tmp_path, name, change):
    path = tmp_path / 'drive.safetensors'
    arrays = load_file(drive_file)
    with safe_open(drive_file, 'np') as file:
        head = file.metadata()
    changed = np.ascontiguousarray(change(arrays[name]))
    save_file(arrays | {name: changed}, path, head)
    assert read_encoded_sequence(path) is None


class Counting(GeometricBackbone):
    opened = 0

    def open(self, camera):
        Counting.opened += 1
        return super().open(camera)


@pytest.fixture(autouse=True)
def nothing_opened() -> None:
    Counting.opened = 0


def test_a_variant_is_tracked_once(tmp_path):
    for _ in range(2):
        archive = EncodedSequenceCache(Counting(), READING, {'seed': 0}, tmp_path)
        for _ in range(2):
            archive.variant(SEQUENCES[0], Augmentation(), 1)
            archive.whole(SEQUENCES[0])
    assert Counting.opened == 2 and len(list(tmp_path.iterdir())) == 2
    for other in (EncodedSequenceCache(Counting(), READING, {'seed': 1}, tmp_path),
                  EncodedSequenceCache(Counting(), SequenceOptions(stop=25), {'seed': 0}, tmp_path)):
        other.whole(SEQUENCES[0])
    assert Counting.opened == 4


def add_a_line(path: Path) -> None:
    path.write_text(path.read_text() + '# changed\n')


def touch(path: Path) -> None:
    """Make a file a later one, of the same size."""
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))


@pytest.mark.parametrize(('kind', 'change'), [
    ('euroc', lambda path: add_a_line(path / 'mav0/state_groundtruth_estimate0/data.csv')),
    ('euroc', lambda path: touch(path / 'mav0/cam0/sensor.yaml')),
    ('euroc', lambda path: touch(sorted((path / 'mav0/cam0/data').iterdir())[0])),
    ('tartanair', lambda path: add_a_line(path / 'pose_left.txt')),
    ('kitti', lambda path: touch(path.parents[1] / 'poses' / '03.txt'))])
def test_of_a_sequence_that_changed_old_tracks_are_not_served(kind, change, tmp_path):
    path, _ = DATASETS[kind](tmp_path, [make_image(index) for index in range(20)],
                             make_poses(20))
    for _ in range(2):
        EncodedSequenceCache(Counting(), SequenceOptions(), folder=tmp_path / 'cache').whole(str(path))
    assert Counting.opened == 1
    change(path)
    EncodedSequenceCache(Counting(), SequenceOptions(), folder=tmp_path / 'cache').whole(str(path))
    assert Counting.opened == 2


def test_what_is_beside_a_file_belongs_to_it_and_not_to_what_is_rendered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'drive.bag').write_text('a bag')
    archive = EncodedSequenceCache(Counting(), READING)
    before = [archive._key(text, None, 0) for text in ('drive.bag', SEQUENCES[0])]
    write_camera_info(tmp_path, 30.0)
    after = [archive._key(text, None, 0) for text in ('drive.bag', SEQUENCES[0])]
    assert before[0] != after[0] and before[1] == after[1]


def test_with_another_calibration_old_tracks_are_not_served(tmp_path):
    path, _ = DATASETS['tartanair'](tmp_path, [make_image(index) for index in range(20)],
                                    make_poses(20))
    for count, focal in enumerate((30.0, 30.0, 31.0)):
        write_camera_info(tmp_path, focal)
        reading = SequenceOptions(camera=str(tmp_path / 'camera_info.yaml'))
        EncodedSequenceCache(Counting(), reading, folder=tmp_path / 'cache').whole(str(path))
        assert Counting.opened == max(count, 1)


class Circle:
    """Garbage that only a search for it finds."""

    def __init__(self) -> None:
        self.itself = self


def test_drives_that_are_not_searched_for_garbage_keep_none(backbone):
    archive = EncodedSequenceCache(backbone, READING)
    garbage, used = Circle(), Circle()
    watched = [weakref.ref(each) for each in (garbage, used)]
    gc.disable()
    try:
        del garbage
        archive.whole(SEQUENCES[0])
        assert gc.get_freeze_count() > 0 and watched[0]() is None
        del used
        EncodedSequenceCache(backbone, READING)
        gc.collect()
        assert watched[1]() is None
    finally:
        gc.enable()


def test_images_of_many_sequences_are_not_held_at_once(backbone):
    drives = EncodedSequenceCache(backbone, READING, live=True).wholes(SEQUENCES)
    assert len(drives) == len(SEQUENCES)
    before = None
    for drive in drives:
        assert drive.frames[0].image.size > 0
        assert before is None or before() is None
        before = weakref.ref(drive)
        del drive


def test_workers_change_nothing(cache):
    told, earned = run(lesson(cache), workers=1)
    told_by_two, earned_by_two = run(lesson(cache), workers=2)
    np.testing.assert_array_equal(told, told_by_two)
    np.testing.assert_array_equal(earned, earned_by_two)


def test_a_seed_makes_the_episodes(cache):
    first, again, other = (run(lesson(cache, variants=2), 1, seed, 5)[0]
                           for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_episodes_begin_anywhere_but_at_the_very_end(cache, monkeypatch):
    monkeypatch.setattr(sampler, 'LEAST_LEFT', 20)
    lengths = []
    usual = sampler.Episode

    def begin(drive, *others):
        lengths.append(len(drive))
        return usual(drive, *others)

    monkeypatch.setattr(sampler, 'Episode', begin)
    run(lesson(cache), 1, steps=100)
    assert min(lengths) >= 20 and len(set(lengths)) > 4


def test_where_there_is_never_anything_to_decide_it_ends(cache, monkeypatch):
    monkeypatch.setattr(sampler, 'MOST_UNASKED', 3)
    environment = make_environment(lesson(cache, rail=KeyframeGuard(0.0, 1, 0.0)), 2, 1, 0)
    with pytest.raises(KfvoError, match='synthetic:.* expected decisions to learn from, '
                                        'there were none in 3 episodes'):
        environment.reset()


def test_parts_of_the_observation_can_be_hidden(cache):
    everything = run(lesson(cache), 1, steps=1)[0]
    some = run(lesson(cache, seen=(('poses', 49), ('gap', 1))), 1, steps=1)[0]
    np.testing.assert_array_equal(some[..., :49], everything[..., 48:97])
    assert some.shape[-1] == 50


@pytest.mark.parametrize('workers', [1, 2])
@pytest.mark.parametrize('changes, expected', [
    ({'sequences': ('synthetic:4', '/nowhere')}, 'nowhere'),
    ({'reading': SequenceOptions(stop=10)}, 'expected at least 20 frames'),
    ({'cache': Path('/dev/null/cache')}, 'cannot keep tracks in /dev/null/cache')])
def test_what_cannot_be_learned_from_is_said_in_one_line(tmp_path, workers, changes, expected):
    wrong = EnvironmentConfig(**{'sequences': SEQUENCES, 'reading': READING, 'cache': tmp_path} | changes)
    with pytest.raises(KfvoError, match=expected) as error:
        environment = make_environment(wrong, 2, workers, 0)
        try:
            environment.reset()
        finally:
            environment.close()
    assert '\n' not in str(error.value)
