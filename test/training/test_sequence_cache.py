# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cache of encoded sequences: files, memory and garbage collection."""

from __future__ import annotations

import gc
import os
import weakref
from pathlib import Path

import pytest
from sequence_writers import DATASETS, make_image, make_poses, write_camera_info

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.odometry.options import SequenceOptions
from kfvo_ros.training.augmentation import Augmentation
from kfvo_ros.training.sequence_cache import EncodedSequenceCache

OPTIONS = SequenceOptions(stop=30)
SEQUENCES = ('synthetic:2:smooth', 'synthetic:4:smooth', 'synthetic:6:smooth')


@pytest.fixture(scope='module')
def backbone() -> GeometricBackbone:
    return GeometricBackbone()


class OpenCountingBackbone(GeometricBackbone):
    opened = 0

    def open(self, camera):
        OpenCountingBackbone.opened += 1
        return super().open(camera)


@pytest.fixture(autouse=True)
def reset_count() -> None:
    OpenCountingBackbone.opened = 0


def test_a_sequence_is_encoded_once(tmp_path):
    for _ in range(2):
        cache = EncodedSequenceCache(OpenCountingBackbone(), OPTIONS, {'seed': 0}, tmp_path)
        for _ in range(2):
            cache.variant(SEQUENCES[0], Augmentation(), 1)
            cache.sequence(SEQUENCES[0])
    assert OpenCountingBackbone.opened == 2 and len(list(tmp_path.iterdir())) == 2
    for options, seed in ((OPTIONS, 1), (SequenceOptions(stop=25), 0)):
        other = EncodedSequenceCache(OpenCountingBackbone(), options, {'seed': seed}, tmp_path)
        other.sequence(SEQUENCES[0])
    assert OpenCountingBackbone.opened == 4


def add_a_line(path: Path) -> None:
    path.write_text(path.read_text() + '# changed\n')


def touch(path: Path) -> None:
    """Change the modification time of a file."""
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))


@pytest.mark.parametrize(('kind', 'change'), [
    ('euroc', lambda path: add_a_line(path / 'mav0/state_groundtruth_estimate0/data.csv')),
    ('euroc', lambda path: touch(path / 'mav0/cam0/sensor.yaml')),
    ('euroc', lambda path: touch(sorted((path / 'mav0/cam0/data').iterdir())[0])),
    ('tartanair', lambda path: add_a_line(path / 'pose_left.txt')),
    ('kitti', lambda path: touch(path.parents[1] / 'poses' / '03.txt'))])
def test_a_changed_sequence_is_encoded_again(kind, change, tmp_path):
    path, _ = DATASETS[kind](tmp_path, [make_image(index) for index in range(20)],
                             make_poses(20))
    for expected in (1, 1, 2):
        if expected == 2:
            change(path)
        EncodedSequenceCache(OpenCountingBackbone(), SequenceOptions(),
                             folder=tmp_path / 'cache').sequence(str(path))
        assert OpenCountingBackbone.opened == expected


def test_a_calibration_beside_a_file_changes_its_key_only(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'room.bag').write_text('a bag')
    cache = EncodedSequenceCache(OpenCountingBackbone(), OPTIONS)
    before = [cache._file_stem(text, None, 0) for text in ('room.bag', SEQUENCES[0])]
    write_camera_info(tmp_path, 30.0)
    after = [cache._file_stem(text, None, 0) for text in ('room.bag', SEQUENCES[0])]
    assert before[0] != after[0] and before[1] == after[1]


def test_with_another_calibration_a_sequence_is_encoded_again(tmp_path):
    path, _ = DATASETS['tartanair'](tmp_path, [make_image(index) for index in range(20)],
                                    make_poses(20))
    for count, focal in enumerate((30.0, 30.0, 31.0)):
        write_camera_info(tmp_path, focal)
        options = SequenceOptions(camera=str(tmp_path / 'camera_info.yaml'))
        EncodedSequenceCache(OpenCountingBackbone(), options,
                             folder=tmp_path / 'cache').sequence(str(path))
        assert OpenCountingBackbone.opened == max(count, 1)


class ReferenceCycle:
    """Garbage that only the garbage collector finds."""

    def __init__(self) -> None:
        self.itself = self


def test_frozen_sequences_freeze_no_garbage(backbone):
    cache = EncodedSequenceCache(backbone, OPTIONS)
    garbage, used = ReferenceCycle(), ReferenceCycle()
    watched = [weakref.ref(each) for each in (garbage, used)]
    gc.disable()
    try:
        del garbage
        cache.sequence(SEQUENCES[0])
        assert gc.get_freeze_count() > 0 and watched[0]() is None
        del used
        EncodedSequenceCache(backbone, OPTIONS)
        gc.collect()
        assert watched[1]() is None
    finally:
        gc.enable()


def test_images_of_one_sequence_only_are_in_memory(backbone):
    sequences = EncodedSequenceCache(backbone, OPTIONS, keep_images=True).sequences(SEQUENCES)
    assert len(sequences) == len(SEQUENCES)
    before = None
    for sequence in sequences:
        assert sequence.frames[0].image.size > 0
        assert before is None or before() is None
        before = weakref.ref(sequence)
        del sequence
