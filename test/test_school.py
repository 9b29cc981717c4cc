# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From names of sequences to episodes: drives on disk, workers, what can be refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.learning.archive import Archive
from kfvo_ros.learning.augmentation import Augmentation
from kfvo_ros.learning.drive_file import read_drive, write_drive
from kfvo_ros.learning.drives import record
from kfvo_ros.learning.environment import OBSERVATION, PRIVILEGED
from kfvo_ros.learning.school import Lesson, make_environment
from kfvo_ros.options import SequenceOptions
from kfvo_ros.sequences.synthetic import SyntheticSequence

FRAMES = 30
READING = SequenceOptions(stop=FRAMES)
SEQUENCES = ('synthetic:2:smooth', 'synthetic:4:smooth', 'synthetic:6:smooth')


@pytest.fixture(scope='module')
def backbone() -> GeometricBackbone:
    return GeometricBackbone()


@pytest.fixture(scope='module')
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp('cache')


def lesson(cache: Path, **changes) -> Lesson:
    return Lesson(SEQUENCES, READING, augmentation=Augmentation(frames=FRAMES, max_stride=1),
                  cache=cache, **{'variants': 1} | changes)


def run(lesson: Lesson, workers: int, seed: int = 0, steps: int = 40):
    environment = make_environment(lesson, 3, workers, seed)
    try:
        told = [environment.reset()[OBSERVATION]]
        earned, dice = [], np.random.default_rng(0)
        for _ in range(steps):
            observations, rewards, _, _ = environment.step(dice.integers(0, 2, 3))
            told.append(observations[OBSERVATION])
            earned.append(rewards)
        assert observations[PRIVILEGED].shape[0] == environment.num_envs == 3
        return np.array(told), np.array(earned)
    finally:
        environment.close()


def test_a_drive_comes_back_from_its_file_as_it_was(backbone, tmp_path):
    drive = record(SyntheticSequence(2, 'smooth', 8, 160, 120), backbone)
    write_drive(tmp_path / 'drive.safetensors', drive)
    back = read_drive(tmp_path / 'drive.safetensors')
    assert back.name == drive.name and len(back) == len(drive) == 8
    np.testing.assert_array_equal(back.T_truth_camera, drive.T_truth_camera)
    for ours, theirs in zip(back.encoded, drive.encoded, strict=True):
        assert ours.stamp_ns == theirs.stamp_ns and ours.payload.index == theirs.payload.index
        np.testing.assert_array_equal(ours.descriptor, theirs.descriptor)
        for a, b in ((ours.tracks, theirs.tracks), (ours.payload.tracks, theirs.payload.tracks)):
            np.testing.assert_array_equal(a.ids, b.ids)
            np.testing.assert_array_equal(a.pixels, b.pixels)
            np.testing.assert_array_equal(a.doubts, b.doubts)
        np.testing.assert_array_equal(ours.payload.points, theirs.payload.points)
    assert back.frames[0].camera == drive.frames[0].camera
    assert drive.encoded[-1].tracks.doubts.any()


@pytest.mark.parametrize('damage', [b'', b'nonsense', b'\x00' * 100])
def test_a_damaged_file_is_as_good_as_none(backbone, tmp_path, damage):
    path = tmp_path / 'drive.safetensors'
    path.write_bytes(damage)
    assert read_drive(path) is None


def test_a_variant_is_tracked_once(backbone, tmp_path):
    class Counting(GeometricBackbone):
        opened = 0

        def open(self, camera):
            Counting.opened += 1
            return super().open(camera)

    for _ in range(2):
        archive = Archive(Counting(), READING, {'seed': 0}, tmp_path)
        for _ in range(2):
            archive.variant(SEQUENCES[0], Augmentation(), 1)
            archive.whole(SEQUENCES[0])
    assert Counting.opened == 2 and len(list(tmp_path.iterdir())) == 2
    for other in (Archive(Counting(), READING, {'seed': 1}, tmp_path),
                  Archive(Counting(), SequenceOptions(stop=25), {'seed': 0}, tmp_path)):
        other.whole(SEQUENCES[0])
    assert Counting.opened == 4


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
    wrong = Lesson(**{'sequences': SEQUENCES, 'reading': READING, 'cache': tmp_path} | changes)
    with pytest.raises(KfvoError, match=expected) as error:
        environment = make_environment(wrong, 2, workers, 0)
        try:
            environment.reset()
        finally:
            environment.close()
    assert '\n' not in str(error.value)
