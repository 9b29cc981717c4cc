# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of a benchmark as declarations: columns and entries, which one builder formats.

The tables are those of the paper, with its numbers beside those measured here, and one of all
errors.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate

from kfvo_ros.evaluation.aggregation import (
    MethodResults,
    Spread,
    collect_results,
    columns_of,
    common_columns,
    label_of,
    median_of,
    methods_of,
)
from kfvo_ros.evaluation.plan import EUROC
from kfvo_ros.evaluation.published import PublishedRow, PublishedTable, published
from kfvo_ros.evaluation.records import FINISHED, TRIVIAL, Row
from kfvo_ros.evaluation.render import NO, NONE, YES, Cell, Mark, Table

Value = Spread | float | str | None
ATE, KEPT = 'ate_rmse_m', 'kept_percent'
ATE_DECIMALS, MAX_DECIMALS, KEPT_DECIMALS, ABLATION_DECIMALS = 3, 6, 1, 3
EVERY = 'every'
FAILURE_SIGN = ' †'
FAILURE_NOTE = '† worse than constant position or a straight line, which use no image: failed.'
PUBLISHED = '{} (published)'
ERROR_NOTES = (
    'ATE: RMSE of the positions of all frames after Sim(3) alignment, also in percent of the '
    'path; the scale [m per unit] that it found; and the same after SE(3) alignment, which leaves '
    'the scale of a single camera in.',
    'RPE: RMSE over one second, and over one metre of true path; KITTI: drift over 100 to 800 m '
    'of path. Both after the Sim(3) scale. A dash: not defined there.')
RUNTIME_NOTE = (
    'Aggregator: encode and estimate, less the head where the backbone reports it. Medians over '
    'the frames, and over sequences and seeds; medians need not add up.')
PUBLISHED_RUNTIME_NOTE = 'Published: means over EuRoC; the head is the "DPT" of the paper.'
ABLATION_NOTE = ('The paper\'s rows, trained for VGGT; `python -m kfvo_ros.ablation` trains such '
                 'rows for the geometric backbone.')


@dataclass(frozen=True)
class Column:
    """A column of numbers: its ``label``, its ``decimals`` and, for medians, a ``field`` of `Row`.

    In a ``ranked`` column less is better: best and second best are marked, and whatever is worse
    than a trivial baseline.
    """

    label: str
    decimals: int
    field: str = ''
    ranked: bool = False

    def cells(self, values: Sequence[Value], are_trivial: Sequence[bool]) -> list[Cell]:
        """Return the cells of this column."""
        texts = [format_value(value, self.decimals) for value in values]
        if not self.ranked:
            return [Cell(text) for text in texts]
        medians = [value.median if isinstance(value, Spread) else None for value in values]
        limit = min((median for median, trivial in zip(medians, are_trivial)
                     if trivial and median is not None), default=math.inf)
        ours = [None if trivial else median for median, trivial in zip(medians, are_trivial)]
        return [Cell(text + FAILURE_SIGN) if median is not None and median > limit
                else Cell(text, mark)
                for text, median, mark in zip(texts, ours, marks(ours, self.decimals))]


@dataclass(frozen=True)
class Entry:
    """A row of a table: ``words``, then ``values`` by column; a str is printed as it is."""

    words: tuple[str, ...]
    values: Sequence[Value]
    is_trivial: bool = False


ERROR_COLUMNS = (
    Column('ATE [m]', 4, ATE), Column('ATE [%]', 3, 'ate_percent'),
    Column('scale', 3, 'ate_scale'), Column('ATE SE(3) [m]', 4, 'ate_se3_rmse_m'),
    Column('RPE 1 s [m]', 4, 'rpe_trans'), Column('RPE 1 s [deg]', 3, 'rpe_rot_deg'),
    Column('RPE 1 m [m]', 4, 'rpe_trans_per_metre'),
    Column('RPE 1 m [deg]', 3, 'rpe_rot_deg_per_metre'),
    Column('KITTI [%]', 3, 'kitti_trans_percent'),
    Column('KITTI [deg/100 m]', 3, 'kitti_rot_deg_per_100m'),
    Column('path [m]', 2, 'path_length_m'), Column('kept [%]', KEPT_DECIMALS, KEPT),
    Column('lost', 0, 'lost_frames'))
RUNTIME_COLUMNS = (
    Column('Aggregator', 2, 'aggregator_ms'), Column('Head', 2, 'head_ms'),
    Column('Decision', 2, 'decide_ms'), Column('Total', 2, 'ms_per_frame'),
    Column('Total, 95 %', 2, 'ms_per_frame_p95'))
ABLATION_COLUMNS = (Column('Avg', ABLATION_DECIMALS), Column('Here', 0),
                    Column('Avg here', ABLATION_DECIMALS))


def build_table(title: str, words: Sequence[str], columns: Sequence[Column],
                groups: Sequence[Sequence[Entry]], notes: Iterable[str],
                caveats: Iterable[str] = (), total: bool = False) -> Table:
    """Return a table with a rule between groups; `caveats` come after all notes."""
    entries = [entry for group in groups for entry in group]
    are_trivial = [entry.is_trivial for entry in entries]
    by_column = [column.cells([entry.values[index] for entry in entries], are_trivial)
                 for index, column in enumerate(columns)]
    rows = tuple((*map(Cell, entry.words), *cells)
                 for entry, *cells in zip(entries, *by_column))
    failures = [FAILURE_NOTE] * any(cell.text.endswith(FAILURE_SIGN) for row in rows
                                    for cell in row)
    ends = set(accumulate(map(len, groups))) - {0, len(rows)}
    return Table(title, (*words, *(column.label for column in columns)), rows,
                 (*notes, *failures, *caveats), len(words), total, tuple(sorted(ends)))


def format_value(value: Value, decimals: int) -> str:
    """Return a value as printed, a dash for None.

    Of a spread: the median and, where they print differently, minimum and maximum.
    """
    if value is None:
        return NONE
    if isinstance(value, str):
        return value
    if not isinstance(value, Spread):
        return f'{value:.{decimals}f}'
    median, minimum, maximum = (f'{each:.{decimals}f}' for each in (
        value.median, value.minimum, value.maximum))
    return median if minimum == maximum else f'{median} ({minimum}–{maximum})'


def marks(values: Sequence[float | None], decimals: int) -> list[Mark | None]:
    """Return the marks of a column in which less is better; equal as printed is equal in rank.

    With fewer than two values nothing is marked.
    """
    printed = [None if value is None else round(value, decimals) for value in values]
    ranks = sorted({value for value in printed if value is not None})
    if len(values) - printed.count(None) < 2:
        return [None] * len(values)
    best, second = (*ranks, None)[:2]
    return [None if value is None else 'best' if value == best
            else 'second' if value == second else None for value in printed]


def ate_table(dataset: str, rows: Sequence[Row], notes: Sequence[str], whole: bool) -> Table:
    """Return the ATE of each method on the sequences of a dataset, in the paper's layout.

    Published entries are of whole sequences: they are left out unless `whole`. Averages are over
    the sequences that all entries have. Marks rank the methods measured here.
    """
    labels, results = columns_of(rows), collect_results(rows, methods_of(rows), ATE)
    paper = published().ate.get(dataset) if whole else None
    reported = _published_results(paper, labels)
    common = common_columns([*results, *reported], labels)
    decimals = _ate_decimals(results, paper)
    entries = [Entry(_method_words(each.method), [*map(each.spread, labels), each.average(common)],
                     each.method in TRIVIAL) for each in results]
    others = [_published_entry(row, each, paper, labels, common)
              for row, each in zip(paper.rows, reported)] if paper else []
    more = [] if len(common) == len(labels) else [
        f'Avg: over {", ".join(common)}, which all rows have.' if common else
        'No Avg: no sequence is in all rows.']
    return build_table(f'ATE [m] on {dataset}', ('Method', 'Keyframe', 'Post-Processing'),
                       [Column(label, decimals, ranked=True) for label in (*labels, 'Avg')],
                       [*_split_trivial(entries), others], [*notes, *more],
                       published().caveats if others else (), total=True)


def strategy_table(by_dataset: dict[str, list[Row]], notes: Sequence[str], whole: bool) -> Table:
    """Return average ATE and keyframes of each method by dataset, with the paper's averages.

    Averages measured here are over the sequences that all methods have, the paper's over all its
    sequences: those are left out unless `whole`, and for a dataset with sequences that the paper
    does not have.
    """
    methods = methods_of(row for rows in by_dataset.values() for row in rows)
    columns, over = [], []
    values: dict[str, list[Value]] = {method: [] for method in methods}
    for dataset, rows in by_dataset.items():
        results = collect_results(rows, methods, ATE)
        common = common_columns(results, columns_of(rows))
        over.append(f'{dataset}: {", ".join(common) or "none"}')
        decimals = _ate_decimals(results, published().ate.get(dataset))
        columns += [Column(dataset, decimals, ranked=True),
                    Column(f'{dataset} kept', KEPT_DECIMALS)]
        for errors, kept in zip(results, collect_results(rows, methods, KEPT)):
            mean = kept.average(tuple(kept.values))
            values[errors.method] += [errors.average(common), mean.median if mean else None]
    entries = [Entry((label_of(method),), values[method], method in TRIVIAL)
               for method in methods]
    others = _published_averages(by_dataset) if whole else []
    more = [f'Averages are over the sequences that all rows have ({"; ".join(over)})'
            + (', published ones over all of the paper.' if others else '.')]
    if others:
        more.append(', '.join(f'{each.method} is {each.ours}'
                              for each in published().strategies) + '.')
    return build_table('Keyframe strategies: average ATE [m], and frames kept [%]', ('Method',),
                       columns, [*_split_trivial(entries), others], [*notes, *more])


def runtime_table(by_dataset: dict[str, list[Row]], whole: bool) -> Table:
    """Return the times of the steps of a frame [ms] by dataset, with the paper's."""
    groups = [_median_entries(dataset, [row for row in rows if row.method not in TRIVIAL],
                              RUNTIME_COLUMNS) for dataset, rows in by_dataset.items()]
    notes = [RUNTIME_NOTE, *_machine_notes(row for rows in by_dataset.values() for row in rows)]
    paper = published().runtime
    if whole and paper['dataset'] in by_dataset:
        groups.append([Entry(
            (paper['dataset'], PUBLISHED.format('Ours')),
            (paper['aggregator'], paper['head'], paper['decide'], paper['total'], None))])
        notes.append(PUBLISHED_RUNTIME_NOTE)
    return build_table('Time of a frame [ms]', ('Dataset', 'Method'), RUNTIME_COLUMNS, groups,
                       notes)


def ablation_table(rows: Sequence[Row]) -> Table:
    """Return the paper's ablation on EuRoC, with our averages of the same methods."""
    results = collect_results(rows, methods_of(rows), ATE)
    common = common_columns(results, columns_of(rows))
    averages = {each.method: each.average(common) for each in results}
    entries = []
    for row in published().ablation:
        ours = averages.get(row.ours or '')
        entries.append(Entry((PUBLISHED.format(row.method),),
                             (row.averages[EUROC], row.ours if ours else None, ours)))
    return build_table('Ablation: average ATE [m] on EuRoC', ('Method',), ABLATION_COLUMNS,
                       [entries], (ABLATION_NOTE, f'Here: over {", ".join(common) or "none"}.'))


def error_table(rows: Sequence[Row]) -> Table:
    """Return the medians over the seeds of every error, by sequence and method."""
    groups = [_median_entries(sequence, [row for row in rows if row.sequence == sequence],
                              ERROR_COLUMNS)
              for sequence in dict.fromkeys(row.sequence for row in rows)]
    return build_table('All errors', ('Sequence', 'Method'), ERROR_COLUMNS, groups, ERROR_NOTES)


def _median_entries(label: str, rows: Iterable[Row], columns: Sequence[Column]) -> list[Entry]:
    """Return an entry for each method: the medians of its finished runs."""
    finished = [row for row in rows if row.status == FINISHED]
    return [Entry((label, label_of(method)),
                  [median_of((row for row in finished if row.method == method), column.field)
                   for column in columns]) for method in methods_of(finished)]


def _split_trivial(entries: Sequence[Entry]) -> tuple[list[Entry], list[Entry]]:
    """Return methods and trivial baselines."""
    return ([entry for entry in entries if not entry.is_trivial],
            [entry for entry in entries if entry.is_trivial])


def _method_words(method: str) -> tuple[str, str, str]:
    """Return label, keyframes and post-processing of a method."""
    if method in TRIVIAL:
        return label_of(method), NONE, NONE
    return method, NO if method == EVERY else YES, 'No'


def _ate_decimals(results: Sequence[MethodResults], paper: PublishedTable | None) -> int:
    """Return the paper's decimals, or more for two digits of our smallest error."""
    medians = (spread.median for each in results if each.method not in TRIVIAL
               for spread in map(each.spread, each.values) if spread)
    smallest = min((median for median in medians if median > 0.0), default=1.0)
    needed = 1 - math.floor(math.log10(smallest))
    return min(max(paper.decimals if paper else ATE_DECIMALS, needed), MAX_DECIMALS)


def _published_results(paper: PublishedTable | None, columns: Sequence[str]
                       ) -> list[MethodResults]:
    """Return the paper's errors in these columns, [] where it has none."""
    if paper is None or not set(columns) & set(paper.sequences):
        return []
    return [MethodResults(row.method, {column: {None: error} for column, error
                                       in zip(paper.sequences, row.errors) if column in columns})
            for row in paper.rows]


def _published_entry(row: PublishedRow, results: MethodResults, paper: PublishedTable,
                     columns: Sequence[str], common: Sequence[str]) -> Entry:
    """Return an entry of the paper's ATE table, with its average where it is of the same."""
    average = results.average(common) if set(common) != set(paper.sequences) else row.average
    values = [format_value(value, paper.decimals)
              for value in (*map(results.spread, columns), average)]
    return Entry((PUBLISHED.format(row.method), YES if row.keyframes else NO,
                  'Required' if row.post_processing else 'No'), values)


def _published_averages(by_dataset: dict[str, list[Row]]) -> list[Entry]:
    """Return the paper's averages, [] where it has none of these datasets."""
    paper = published()
    present = [dataset for dataset, rows in by_dataset.items()
               if paper.has_all(dataset, columns_of(rows))]
    return [Entry((PUBLISHED.format(row.method),), [
        value for dataset in by_dataset for value in (
            format_value(row.averages[dataset], paper.ate[dataset].decimals)
            if dataset in present else None, None)]) for row in paper.strategies if present]


def _machine_notes(rows: Iterable[Row]) -> list[str]:
    """Return the machines that measured the times, one note each."""
    machines = dict.fromkeys((row.machine, row.device, row.jobs) for row in rows
                             if row.machine and row.status == FINISHED)
    return [f'Measured on {machine}{"" if device == "cpu" else f", {device}"}; '
            f'{jobs} {"run" if jobs == 1 else "runs"} side by side.'
            for machine, device, jobs in machines]
