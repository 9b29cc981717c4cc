# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The sequences of a benchmark by name, dataset and column, and its default methods."""

from __future__ import annotations

from pathlib import Path

import pytest
from sequence_writers import write_dataset

from kfvo_ros.evaluation.plan import BenchmarkSequence, default_methods, open_benchmark_sequences
from kfvo_ros.keyframes import HEURISTICS
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions


def open_renamed(path: Path, name: str) -> BenchmarkSequence:
    """Rename the folder of a sequence, then open it."""
    renamed = str(path.rename(path.with_name(name)))
    sequence, = open_benchmark_sequences([renamed], SequenceOptions())
    return sequence


@pytest.mark.parametrize(('kind', 'name', 'dataset', 'column'), [
    ('euroc', 'MH_01_easy', 'EuRoC', 'MH01'), ('euroc', 'V2_03_difficult', 'EuRoC', 'V203'),
    ('euroc', 'V1_01', 'EuRoC', 'V101'), ('euroc', 'V1_01_static', 'EuRoC', 'V1-01-static'),
    ('tum', 'rgbd_dataset_freiburg1_desk2', 'TUM-RGBD', 'fr1-desk2'),
    ('tum', 'rgbd_dataset_freiburg3_long_office', 'TUM-RGBD', 'fr3-long-office'),
    ('tum', 'fr1_xyz', 'TUM-RGBD', 'fr1-xyz'), ('kitti', '07', 'KITTI', '07'),
    ('tartanair', 'P003', 'TartanAir', 'hospital/Easy/P003')])
def test_dataset_and_column_follow_the_paper(kind, name, dataset, column, tmp_path):
    path, _ = write_dataset(kind, tmp_path)
    sequence = open_renamed(path, name)
    assert (sequence.dataset, sequence.column) == (dataset, column)


def test_synthetic_sequences_and_unknown_names():
    smooth, mixed = open_benchmark_sequences(['synthetic:3:smooth', 'synthetic:3'],
                                             SequenceOptions())
    assert (smooth.dataset, smooth.column, smooth.folder) == (
        'Synthetic', '3:smooth', 'synthetic_3_smooth')
    assert (mixed.name, mixed.column) == ('synthetic:3:mixed', '3:mixed')
    assert BenchmarkSequence('x', '../..', 'Other', 'x').folder == '_'


def test_sequences_of_one_name_are_numbered(tmp_path):
    paths = [write_dataset('kitti', tmp_path / name)[0] for name in ('a', 'b')]
    texts = [*map(str, paths), str(paths[0])]
    sequences = open_benchmark_sequences(texts, SequenceOptions())
    assert [(each.name, each.column, each.folder) for each in sequences] == [
        ('kitti/03', '03', 'kitti_03'), ('kitti/03-2', '03-2', 'kitti_03-2')]


def test_paths_become_absolute(tmp_path, monkeypatch):
    path, _ = write_dataset('tum', tmp_path)
    monkeypatch.chdir(tmp_path)
    sequence, = open_benchmark_sequences([path.name], SequenceOptions())
    assert sequence.text == str(path)
    assert len(sequence.ground_truth(SequenceOptions()).trajectory) > 0


def test_the_shipped_policy_is_a_default_method_where_it_matches():
    assert default_methods(OdometryOptions()) == (*HEURISTICS, 'learned')
    for options in (OdometryOptions(window_size=6), OdometryOptions(scale_rule='none'),
                    OdometryOptions(backbone='vggt')):
        assert default_methods(options) == HEURISTICS
    assert default_methods(OdometryOptions(window_size=6, policy='mine.safetensors')) == (
        *HEURISTICS, 'learned')
