# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of a benchmark: medians, averages, marks and published numbers."""

from __future__ import annotations

from dataclasses import replace

import pytest
from benchmark_rows import make_rows

from kfvo_ros.evaluation.aggregation import MethodResults, Spread
from kfvo_ros.evaluation.published import published
from kfvo_ros.evaluation.records import FAILED
from kfvo_ros.evaluation.render import Table
from kfvo_ros.evaluation.report import Provenance, make_tables
from kfvo_ros.evaluation.tables import (
    FAILURE_NOTE,
    Column,
    Entry,
    ablation_table,
    ate_table,
    build_table,
    error_table,
    format_value,
    marks,
    runtime_table,
    strategy_table,
)

PROVENANCE = Provenance('python -m kfvo_ros.benchmark', '0.1.0', None, None)


def texts(table: Table) -> dict[str, list[str]]:
    """Return the rows by their first cells."""
    return {row[0].text: [cell.text for cell in row[1:]] for row in table.rows}


def marked(table: Table, column: str) -> dict[str, str | None]:
    """Return the marks of a column by the first cells of the rows."""
    index = table.head.index(column)
    return {row[0].text: row[index].mark for row in table.rows}


def test_build_table_formats_marks_and_separates_groups():
    groups = [[Entry(('a',), (Spread(1.0, 0.5, 2.0), 0.25)), Entry(('b',), (None, None)),
               Entry(('c',), (Spread(3.0, 3.0, 3.0), 1))],
              [], [Entry(('trivial',), (Spread(2.0, 2.0, 2.0), None), is_trivial=True)],
              [Entry(('published',), ('0.7', None))]]
    table = build_table('title', ('Method',), [Column('x', 1, ranked=True), Column('y', 2)],
                        groups, ['note'], ['caveat'])
    assert table.head == ('Method', 'x', 'y') and (table.words, table.total) == (1, False)
    assert texts(table) == {'a': ['1.0 (0.5–2.0)', '0.25'], 'b': ['–', '–'],
                            'c': ['3.0 †', '1.00'], 'trivial': ['2.0', '–'],
                            'published': ['0.7', '–']}
    assert marked(table, 'x') == dict.fromkeys(texts(table), None) | {'a': 'best'}
    assert table.notes == ('note', FAILURE_NOTE, 'caveat') and table.rules == (3, 4)


def test_median_and_spread_of_the_seeds():
    rows = make_rows('KITTI', '03', {'every': [1.0, 3.0, 1.2], 'survival': [2.0, 2.0, 2.0]})
    table = texts(ate_table('KITTI', rows, (), True))
    assert table['every'] == ['✗', 'No', '1.2 (1.0–3.0)', '1.2 (1.0–3.0)']
    assert table['survival'] == ['✓', 'No', '2.0', '2.0']
    assert table['constant position'] == ['–', '–', '9.0', '9.0']
    assert list(table)[2:4] == ['constant position', 'straight line']


def test_the_average_is_of_each_seed_and_over_common_sequences():
    rows = [*make_rows('TUM-RGBD', 'fr1-rpy', {'every': [0.1, 0.3], 'survival': [0.2, 0.2]}),
            *make_rows('TUM-RGBD', 'fr1-xyz', {'every': [0.4, 0.2], 'survival': [0.2, 0.2]}),
            *make_rows('TUM-RGBD', 'mine', {'every': [0.5, 0.5], 'survival': [0.5, 0.5]})]
    table = ate_table('TUM-RGBD', rows, (), True)
    found = texts(table)
    assert found['every'][-1] == '0.250'  # 0.25 with either seed, though the medians are 0.2, 0.3
    assert found['InfiniteVGGT (published)'] == ['✗', 'No', '0.053', '0.177', '–', '0.115']
    assert 'Avg: over fr1-rpy, fr1-xyz, which all rows have.' in table.notes
    assert any('loop closure' in note for note in table.notes)


def test_a_failed_run_has_no_number_and_its_sequence_no_part_in_the_average():
    rows = [*make_rows('EuRoC', 'MH01', {'every': [1.0], 'survival': [2.0]}),
            *make_rows('EuRoC', 'V101', {'every': [3.0], 'survival': [4.0]})]
    index = next(i for i, row in enumerate(rows) if (row.method, row.column) == ('every', 'V101'))
    rows[index] = replace(rows[index], status=FAILED, problem='no light')
    table = make_tables(rows, PROVENANCE)[0]
    assert texts(table)['every'] == ['✗', 'No', '1.00', '–', '1.00']
    assert texts(table)['survival'][-1] == '2.00'
    assert 'every on V101, seed 0: failed: no light' in table.notes


def test_without_a_common_sequence_there_is_no_average():
    rows = [*make_rows('Synthetic', '1', {'every': [1.0]}, (9.0, 9.0)),
            *make_rows('Synthetic', '2', {'survival': [1.0]}, (9.0, 9.0))]
    table = ate_table('Synthetic', rows, (), True)
    assert texts(table)['every'] == ['✗', 'No', '1.000', '–', '–']
    assert 'No Avg: no sequence is in all rows.' in table.notes


def test_a_published_average_stays_as_printed():
    paper = published().ate['EuRoC']
    rows = [row for column in paper.sequences
            for row in make_rows('EuRoC', column, {'every': [1.0]})]
    found = texts(ate_table('EuRoC', rows, (), True))
    assert found['VGGT-Long (published)'][2:] == [
        '2.11', '2.19', '3.10', '4.65', '4.99', '1.46', '1.60', '1.48', '1.68', '1.79', '1.91',
        '2.45']


@pytest.mark.parametrize(('column', 'whole'), [('fr1-desk', False), ('fr1-desk-excerpt', True)])
def test_excerpts_have_no_published_rows(column, whole):
    table = ate_table('TUM-RGBD', make_rows('TUM-RGBD', column, {'every': [0.1]}), (), whole)
    assert not any('published' in name for name in texts(table)) and not table.notes


def test_marks_rank_the_methods_measured_here():
    rows = make_rows('KITTI', '04', {'every': [9.01], 'optical_flow': [4.0], 'survival': [4.04],
                                   'learned': [5.0]}, (20.0, 30.0))
    table = ate_table('KITTI', rows, (), True)
    found = marked(table, '04')  # FastVGGT has 2.5, VGGT-SLAM 4.9
    assert {name: mark for name, mark in found.items() if mark} == {
        'optical_flow': 'best', 'survival': 'best', 'learned': 'second'}


def test_a_method_worse_than_a_trivial_baseline_has_failed():
    rows = make_rows('KITTI', '04', {'every': [2.9], 'survival': [3.1]}, (3.0, 30.0))
    table = ate_table('KITTI', rows, (), True)
    assert texts(table)['survival'][2:] == ['3.1 †', '3.1 †'] and FAILURE_NOTE in table.notes
    assert marked(table, '04')['every'] == 'best' and marked(table, '04')['survival'] is None


def test_marks():
    assert marks([3.0, None, 1.0, 2.0], 1) == [None, None, 'best', 'second']
    assert marks([None, 1.0], 1) == [None, None]  # nothing to compare with
    assert marks([1.04, 1.0], 1) == ['best', 'best']
    assert marks([], 1) == []


def test_decimals_follow_the_smallest_error():
    rows = make_rows('Synthetic', '1', {'every': [0.00123], 'survival': [0.5]})
    assert texts(ate_table('Synthetic', rows, (), True))['every'][2] == '0.0012'
    assert format_value(Spread.of([0.0004, 0.0001, 0.0002]), 3) == '0.000'
    assert MethodResults('every', {'a': {0: 1.0}, 'b': {1: 2.0}}).average(('a', 'b')) is None


def test_strategy_table():
    by_dataset = {
        'TUM-RGBD': [*make_rows('TUM-RGBD', 'fr1-rpy', {'every': [0.1], 'optical_flow': [0.2]}),
                     *make_rows('TUM-RGBD', 'fr1-xyz', {'every': [0.3], 'optical_flow': [0.2]})],
        'Synthetic': make_rows('Synthetic', '1', {'every': [0.01], 'learned': [0.02]})}
    table = strategy_table(by_dataset, (), True)
    found = texts(table)
    assert table.head == ('Method', 'TUM-RGBD', 'TUM-RGBD kept', 'Synthetic', 'Synthetic kept')
    assert found['every'] == ['0.200', '40.0', '0.010', '40.0']
    assert found['learned'] == ['–', '–', '0.020', '40.0']
    assert found['VGGT-LK (published)'] == ['0.194', '–', '–', '–']
    assert any('VGGT-SW is every' in note for note in table.notes)
    assert 'VGGT-LK (published)' not in texts(strategy_table(by_dataset, (), False))


def test_averages_over_other_sequences_have_no_published_rows():
    rows = {'EuRoC': [*make_rows('EuRoC', 'MH01', {'every': [1.0]}),
                      *make_rows('EuRoC', 'V1-01-easy-static', {'every': [0.1]})]}
    assert 'VGGT-SW (published)' not in texts(strategy_table(rows, (), True))
    titles = [table.title for table in make_tables(rows['EuRoC'], PROVENANCE)]
    assert not any('Ablation' in title for title in titles)
    titles = [table.title for table in make_tables(rows['EuRoC'][:3], PROVENANCE)]
    assert any('Ablation' in title for title in titles)


def test_runtime_table():
    rows = make_rows('EuRoC', 'MH01', {'every': [1.0, 1.0]})
    rows[0] = replace(rows[0], encode_ms=9.0)
    vggt = [replace(row, head_ms=3.0, device='cuda:0 a GPU') for row in rows[:2]]
    plain = texts(runtime_table({'EuRoC': rows}, True))
    assert plain['EuRoC'][0] == 'Ours (published)'  # the last of two rows of that name
    table = runtime_table({'EuRoC': vggt}, True)
    assert [cell.text for cell in table.rows[0]] == [
        'EuRoC', 'every', '9.00', '3.00', '0.50', '12.00', '–']
    assert [cell.text for cell in table.rows[1]] == [
        'EuRoC', 'Ours (published)', '370.00', '1.10', '0.74', '380.20', '–']
    assert 'Measured on a machine, cuda:0 a GPU; 1 run side by side.' in table.notes
    assert [cell.text for cell in runtime_table({'EuRoC': rows}, False).rows[0]][3] == '–'


def test_ablation_table():
    rows = make_rows('EuRoC', 'MH01', {'every': [1.0], 'survival': [2.0]})
    found = texts(ablation_table(rows))
    assert found['VGGT-SW (published)'] == ['2.648', 'every', '1.000']
    assert found['Full method (published)'] == ['2.443', '–', '–']


def test_error_table_has_a_row_for_each_sequence_and_method():
    table = error_table([*make_rows('EuRoC', 'MH01', {'every': [1.0, 3.0]}),
                         *make_rows('EuRoC', 'V101', {'every': [2.0]})])
    assert [(row[0].text, row[1].text, row[2].text) for row in table.rows] == [
        ('EuRoC/MH01', 'every', '2.0000'), ('EuRoC/MH01', 'constant position', '9.0000'),
        ('EuRoC/MH01', 'straight line', '8.0000'), ('EuRoC/V101', 'every', '2.0000'),
        ('EuRoC/V101', 'constant position', '9.0000'), ('EuRoC/V101', 'straight line', '8.0000')]
    assert table.rules == (3,)


# Published numbers


def test_published_averages_are_those_of_their_rows():
    for dataset, table in published().ate.items():
        for row in table.rows:
            assert len(row.errors) == len(table.sequences), (dataset, row.method)
            mean = sum(row.errors) / len(row.errors)
            assert abs(mean - row.average) <= 0.5 * 10.0 ** -table.decimals + 1e-9, row


def test_published_tables_agree_with_each_other():
    paper = published()
    ours = {dataset: table.rows[-1].average for dataset, table in paper.ate.items()}
    assert paper.strategies[-1].averages == ours and paper.strategies[-1].ours == 'learned'
    assert round(paper.ablation[1].averages['EuRoC'], 2) == ours['EuRoC']
    runtime = paper.runtime
    assert runtime['aggregator'] + runtime['head'] + runtime['decide'] < runtime['total']
