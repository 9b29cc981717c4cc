# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ablation's table: means, ranges over the seeds, and differences within them."""

from __future__ import annotations

import csv

import pytest

from kfvo_ros.training.ablation_report import PolicyResult, ablation_markdown, write_csv


def results(row: str, *errors: float, has_seeds: bool = True,
            kept: float = 0.5) -> list[PolicyResult]:
    """Return a row of one sequence, with an error for each seed."""
    return [PolicyResult(row, seed if has_seeds else None, 'one', error, kept)
            for seed, error in enumerate(errors)]


def cells(rows: list[PolicyResult]) -> dict[str, list[str]]:
    """Return the table's cells by row."""
    lines = [line for line in ablation_markdown(rows).splitlines() if line.startswith('| `')]
    return {line.split('`')[1]: [cell.strip() for cell in line.split('|')[2:-1]]
            for line in lines}


FULL = results('full', 1.0, 1.1, 1.2)


@pytest.mark.parametrize(('errors', 'verdict'), [
    ((0.85, 0.85, 0.85), 'better'), ((0.92, 0.92, 0.92), 'none'), ((1.1, 1.1, 1.1), 'none'),
    ((1.28, 1.28, 1.28), 'none'), ((1.35, 1.36, 1.37), 'worse'), ((0.5, 0.85, 1.2), 'none'),
    ((1.0, 2.0, 2.2), 'none')])
def test_a_difference_within_the_range_of_the_seeds_is_none(errors, verdict):
    assert cells(FULL + results('local', *errors))['local'][-1] == verdict


def test_a_row_without_seeds_is_compared_with_the_range_of_full():
    rows = (FULL + results('every', 1.25, has_seeds=False)
            + results('survival', 1.35, has_seeds=False))
    table = cells(rows)
    assert table['every'] == ['1.250', '50 %', 'none']
    assert table['survival'][-1] == 'worse'
    assert table['full'] == ['1.100 (1.000, 1.200)', '50 %', '']


def test_one_seed_has_no_range_to_compare():
    assert cells(FULL + results('local', 0.1))['local'][-1] == ''
    assert cells(results('full', 1.0) + results('local', 0.1, 0.2))['local'][-1] == ''
    assert cells(results('local', 0.1, 0.2) + results('every', 9.0, has_seeds=False)) == {
        'local': ['0.150 (0.100, 0.200)', '50 %', ''], 'every': ['9.000', '50 %', '']}


def test_means_are_geometric_over_sequences_and_medians_over_seeds():
    rows = [PolicyResult('full', seed, sequence, error, kept)
            for seed, (a, b, kept) in enumerate([(0.1, 10.0, 0.1), (0.4, 0.1, 0.3),
                                                 (4.0, 4.0, 0.8)])
            for sequence, error in (('a', a), ('b', b))]
    assert cells(rows)['full'] == ['1.000 (0.200, 4.000)', '30 %', '']
    assert 'over 2 sequences' in ablation_markdown(rows)


def test_csv_holds_all_results(tmp_path):
    rows = FULL + results('every', 1.25, has_seeds=False, kept=1.0)
    write_csv(tmp_path / 'table.csv', rows)
    with (tmp_path / 'table.csv').open() as file:
        read = list(csv.DictReader(file))
    assert list(read[0]) == ['row', 'seed', 'sequence', 'ate_percent', 'kept']
    assert [PolicyResult(each['row'], int(each['seed']) if each['seed'] else None,
                         each['sequence'], float(each['ate_percent']), float(each['kept']))
            for each in read] == rows
    assert [path.name for path in tmp_path.iterdir()] == ['table.csv']
