# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of a benchmark: what sequences are called, results.csv, the machine, lists of words."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest
from sequence_writers import write_dataset

from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation.plan import default_methods
from kfvo_ros.evaluation.records import COLUMNS, Row, append_rows, in_order, write_rows
from kfvo_ros.evaluation.sequences import BenchmarkSequence, open_benchmark_sequences
from kfvo_ros.keyframes import HEURISTICS, POLICIES
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions
from kfvo_ros.utils.commands import parse_names, parse_numbers
from kfvo_ros.utils.process import host_info


def called(path: Path, name: str) -> tuple[str, str, str]:
    """Return dataset, column and folder of a sequence, after its folder got another name."""
    subject, = open_benchmark_sequences([str(path.rename(path.with_name(name)))], SequenceOptions())
    return subject.dataset, subject.column, subject.folder


@pytest.mark.parametrize(('kind', 'name', 'dataset', 'column'), [
    ('euroc', 'MH_01_easy', 'EuRoC', 'MH01'), ('euroc', 'V2_03_difficult', 'EuRoC', 'V203'),
    ('euroc', 'V1_01', 'EuRoC', 'V101'), ('euroc', 'V1_01_static', 'EuRoC', 'V1-01-static'),
    ('tum', 'rgbd_dataset_freiburg1_desk2', 'TUM-RGBD', 'fr1-desk2'),
    ('tum', 'rgbd_dataset_freiburg3_long_office', 'TUM-RGBD', 'fr3-long-office'),
    ('tum', 'fr1_xyz', 'TUM-RGBD', 'fr1-xyz'), ('kitti', '07', 'KITTI', '07'),
    ('tartanair', 'P003', 'TartanAir', 'hospital/Easy/P003')])
def test_sequences_are_called_as_the_paper_calls_them(kind, name, dataset, column, tmp_path):
    path, _ = write_dataset(kind, tmp_path)
    assert called(path, name)[:2] == (dataset, column)


def test_rendered_rooms_and_anything_else():
    smooth, mixed = open_benchmark_sequences(['synthetic:3:smooth', 'synthetic:3'], SequenceOptions())
    assert (smooth.dataset, smooth.column, smooth.folder) == (
        'Synthetic', '3:smooth', 'synthetic_3_smooth')
    assert (mixed.name, mixed.column) == ('synthetic:3:mixed', '3:mixed')
    assert BenchmarkSequence('x', '../..', 'Other', 'x').folder == '_'


def test_sequences_of_one_name_are_told_apart(tmp_path):
    paths = [write_dataset('kitti', tmp_path / name)[0] for name in ('a', 'b')]
    texts = [*map(str, paths), str(paths[0])]
    subjects = open_benchmark_sequences(texts, SequenceOptions())
    assert [(each.name, each.column, each.folder) for each in subjects] == [
        ('kitti/03', '03', 'kitti_03'), ('kitti/03-2', '03-2', 'kitti_03-2')]


def test_a_sequence_is_found_from_every_folder(tmp_path, monkeypatch):
    path, _ = write_dataset('tum', tmp_path)
    monkeypatch.chdir(tmp_path)
    subject, = open_benchmark_sequences([path.name], SequenceOptions())
    assert subject.text == str(path)
    assert len(subject.truth(SequenceOptions()).trajectory) > 0


def test_results_are_written_and_appended(tmp_path):
    path, row = tmp_path / 'results.csv', Row('kitti/03', 'every', seed=0)
    write_rows(path, [row])
    append_rows(path, [replace(row, seed=1, problem='a "quoted", two-\nline problem')])
    append_rows(path, [replace(row, problem='=cmd()', ate_rmse_m=-0.5)])
    with path.open(newline='') as file:
        head, *rows = csv.reader(file)
    assert tuple(head) == COLUMNS
    cells = [dict(zip(head, each, strict=True)) for each in rows]
    assert cells[0]['ate_rmse_m'] == cells[0]['problem'] == ''
    assert cells[1]['problem'] == 'a "quoted", two-\nline problem'
    assert (cells[2]['problem'], cells[2]['ate_rmse_m']) == ("'=cmd()", '-0.5')


def test_a_full_disk_is_told(tmp_path):
    (tmp_path / 'results.csv').symlink_to('/dev/full')
    with pytest.raises(KfvoError, match='cannot write .*results.csv: No space left'):
        append_rows(tmp_path / 'results.csv', [Row('a', 'every')])
    with pytest.raises(KfvoError, match='cannot write .*nowhere'):
        write_rows(tmp_path / 'nowhere' / 'results.csv', [])


def test_rows_in_order():
    rows = [Row('b', 'every'), Row('a', 'straight_line'), Row('a', 'survival', seed=1),
            Row('a', 'survival', seed=0), Row('a', 'every')]
    ordered = in_order(rows, ['a', 'b'], ['survival', 'every'])
    assert [(row.sequence, row.method, row.seed) for row in ordered] == [
        ('a', 'survival', 0), ('a', 'survival', 1), ('a', 'every', None),
        ('a', 'straight_line', None), ('b', 'every', None)]


def test_the_machine_is_named():
    name = host_info()
    assert 'cores, Python 3.' in name and not name.startswith(',')


def test_lists():
    assert parse_names('b,a,b', 'letters', ('a', 'b', 'c')) == ('b', 'a')
    assert parse_numbers('2,1,2', 'seeds') == (2, 1)
    with pytest.raises(KfvoError, match="letters: expected names out of a, b, came 'd'"):
        parse_names('a,d', 'letters', ('a', 'b'))
    for text in ('', '1,', '1.5', '-1', '²', '0'):
        with pytest.raises(KfvoError, match='workers: expected whole numbers from 1'):
            parse_numbers(text, 'workers', 1)


def test_the_policy_that_comes_along_is_compared_where_it_fits():
    assert default_methods(OdometryOptions()) == POLICIES
    for options in (OdometryOptions(window_size=6), OdometryOptions(scale_rule='none'),
                    OdometryOptions(backbone='vggt')):
        assert default_methods(options) == HEURISTICS
    assert default_methods(OdometryOptions(window_size=6, policy='mine.safetensors')) == POLICIES
