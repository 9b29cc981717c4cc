# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scores of an estimate, defined and undefined, and the file of rows."""

from __future__ import annotations

import csv
from dataclasses import asdict, replace

import numpy as np
import pytest
from trajectories import along_x, freiburg1_rpy, perturbed, random_walk, trajectory

from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation.metrics import (
    absolute_trajectory_error,
    constant_position,
    kitti_drift,
    relative_pose_error,
    straight_line,
)
from kfvo_ros.evaluation.records import (
    COLUMNS,
    Row,
    Scores,
    append_rows,
    score,
    sort_rows,
    write_rows,
)
from kfvo_ros.trajectory import Trajectory

KITTI = {'kitti_trans_percent', 'kitti_rot_deg_per_100m'}


def undefined(scores: Scores) -> set[str]:
    """Return the names of the scores without a value."""
    return {name for name, value in asdict(scores).items() if value is None}


def test_scores_are_the_metrics():
    truth = random_walk(0, 600)
    estimate = perturbed(truth, 7)
    scores = score(estimate, truth)
    aligned = absolute_trajectory_error(estimate, truth)
    second = relative_pose_error(estimate, truth, 1.0, 'seconds')
    metre = relative_pose_error(estimate, truth, 1.0, 'metres')
    drift = kitti_drift(estimate, truth)
    assert scores == Scores(
        aligned.rmse, aligned.alignment.scale,
        absolute_trajectory_error(estimate, truth, with_scale=False).rmse, truth.path_length,
        100.0 * aligned.rmse / truth.path_length, second.trans_rmse, second.rot_rmse_deg,
        metre.trans_rmse, metre.rot_rmse_deg, drift.trans_percent, drift.rot_deg_per_100m)
    assert scores.ate_scale == pytest.approx(1 / 0.3, rel=0.2)
    assert scores.ate_se3_rmse_m > 2.0 * scores.ate_rmse_m


def test_scores_of_a_perfect_estimate_in_another_scale():
    truth = along_x(*range(301))
    scores = asdict(score(along_x(*np.arange(301) / 4.0), truth))
    assert scores.pop('ate_scale') == pytest.approx(4.0)
    assert scores.pop('path_length_m') == 300.0
    assert scores.pop('ate_se3_rmse_m') == pytest.approx(0.75 * np.std(np.arange(301)))
    assert all(value == pytest.approx(0.0, abs=1e-9) for value in scores.values())


def test_a_path_shorter_than_100_m_has_no_drift():
    truth = along_x(*range(30))
    assert undefined(score(truth, truth)) == KITTI


def test_positions_without_rotation_have_no_relative_error():
    prism = Trajectory(along_x(*range(200)).stamps_ns, along_x(*range(200)).poses, False)
    names = undefined(score(along_x(*range(200)), prism))
    assert names == KITTI | {'rpe_trans', 'rpe_rot_deg', 'rpe_trans_per_metre',
                             'rpe_rot_deg_per_metre'}


def test_a_truth_that_never_moves_defines_no_scale():
    still = trajectory(np.ones((20, 3)))
    scores = score(trajectory(np.random.default_rng(0).normal(0, 0.1, (20, 3))), still)
    assert set(asdict(scores)) - undefined(scores) == {'ate_se3_rmse_m', 'path_length_m'}
    assert scores.path_length_m == 0.0 and 0.1 < scores.ate_se3_rmse_m < 0.3


def test_steps_longer_than_a_metre_and_a_second_have_no_relative_error():
    truth = trajectory(np.cumsum(np.full((30, 3), 2.0), axis=0), step_ms=1500)
    assert undefined(score(truth, truth)) == {
        'rpe_trans', 'rpe_rot_deg', 'rpe_trans_per_metre', 'rpe_rot_deg_per_metre'}


def test_trivial_baselines_are_scored(data_path):
    stamps_ns, truth = freiburg1_rpy(data_path)
    still, line = (score(make(stamps_ns), truth) for make in (constant_position, straight_line))
    assert undefined(still) == KITTI | {'ate_scale'}
    assert undefined(line) == KITTI
    assert still.ate_rmse_m == still.ate_se3_rmse_m == pytest.approx(0.064, abs=0.0005)
    assert line.ate_rmse_m == pytest.approx(0.049, abs=0.0005)


@pytest.mark.parametrize('estimate, problem', [
    (Trajectory(along_x(0, 1, 2).stamps_ns + 10 ** 12, along_x(0, 1, 2).poses), 'same clock'),
    (along_x(0.0, np.nan, 2.0), 'not finite')])
def test_trajectories_that_cannot_be_associated_are_rejected(estimate, problem):
    with pytest.raises(KfvoError, match=problem):
        score(estimate, along_x(0, 1, 2))


# results.csv


def test_rows_are_written_and_appended(tmp_path):
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


def test_errors_of_writing_name_the_file(tmp_path):
    (tmp_path / 'results.csv').symlink_to('/dev/full')
    with pytest.raises(KfvoError, match='cannot write .*results.csv: No space left'):
        append_rows(tmp_path / 'results.csv', [Row('a', 'every')])
    with pytest.raises(KfvoError, match='cannot write .*nowhere'):
        write_rows(tmp_path / 'nowhere' / 'results.csv', [])


def test_rows_are_sorted_by_sequence_method_and_seed():
    rows = [Row('b', 'every'), Row('a', 'straight_line'), Row('a', 'survival', seed=1),
            Row('a', 'survival', seed=0), Row('a', 'every')]
    ordered = sort_rows(rows, ['a', 'b'], ['survival', 'every'])
    assert [(row.sequence, row.method, row.seed) for row in ordered] == [
        ('a', 'survival', 0), ('a', 'survival', 1), ('a', 'every', None),
        ('a', 'straight_line', None), ('b', 'every', None)]
