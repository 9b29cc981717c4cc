# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ATE table of a dataset, in the paper's layout, with the paper's rows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from kfvo_ros.evaluation.aggregation import (
    MethodResults,
    Spread,
    collect_results,
    columns_of,
    common_columns,
    label_of,
    methods_of,
)
from kfvo_ros.evaluation.published import PublishedRow, PublishedTable, published
from kfvo_ros.evaluation.records import FINISHED, TRIVIAL, Row
from kfvo_ros.evaluation.render import NO, NONE, YES, Cell, Table, marks, number, rules_between
from kfvo_ros.evaluation.sequences import EUROC

DECIMALS, MOST_DECIMALS = 3, 6
NEEDED, NOT_NEEDED = 'Required', 'No'
EVERY = 'every'
FAILED = ' †'
FAILURE = '† worse than constant position or a straight line, which see nothing: it failed.'
KEPT_DECIMALS, ABLATION_DECIMALS = 1, 3
ABLATION_NOTE = ('The paper\'s rows, trained for VGGT; `python -m kfvo_ros.ablation` trains such '
                 'rows for the geometric backbone.')
SAME = '{} is {}'
ERRORS = (('ATE [m]', 'ate_rmse_m', 4), ('ATE [%]', 'ate_percent', 3),
          ('scale', 'ate_scale', 3), ('ATE SE(3) [m]', 'ate_se3_rmse_m', 4),
          ('RPE 1 s [m]', 'rpe_trans', 4), ('RPE 1 s [deg]', 'rpe_rot_deg', 3),
          ('RPE 1 m [m]', 'rpe_trans_per_metre', 4),
          ('RPE 1 m [deg]', 'rpe_rot_deg_per_metre', 3), ('KITTI [%]', 'kitti_trans_percent', 3),
          ('KITTI [deg/100 m]', 'kitti_rot_deg_per_100m', 3), ('path [m]', 'path_length_m', 2),
          ('kept [%]', 'kept_percent', 1), ('lost', 'lost_frames', 0))
ERROR_NOTES = (
    'ATE: RMSE of the positions of all frames after Sim(3) alignment, also in percent of the '
    'path; the scale [m per unit] that it found; and the same after SE(3) alignment, which leaves '
    'the scale of a single camera in.',
    'RPE: RMSE over one second, and over one metre of true path; KITTI: drift over 100 to 800 m '
    'of path. Both after the Sim(3) scale. A dash: not defined there.')
STEPS = (('Aggregator', 'aggregator_ms'), ('Head', 'head_ms'), ('Decision', 'decide_ms'),
         ('Total', 'ms_per_frame'), ('Total, 95 %', 'ms_per_frame_p95'))
STEP_DECIMALS = 2
STEP_NOTES = (
    'Aggregator: encode and estimate, less the head where the backbone tells it. Medians over the '
    'frames, and over sequences and seeds; medians need not add up.',)
PUBLISHED_NOTE = 'Published: means over EuRoC; the head is the "DPT" of the paper.'


def ate_table(dataset: str, rows: Sequence[Row], notes: Sequence[str], whole: bool) -> Table:
    """Return the table of these rows, all of the dataset.

    Published rows are of whole sequences: they are left out unless `whole`. Averages are over the
    sequences that all rows have. Best and second best are marked among the methods run here.
    """
    columns, lines = columns_of(rows), collect_results(rows, methods_of(rows), 'ate_rmse_m')
    paper = published().ate.get(dataset) if whole else None
    others = _published_lines(paper, columns)
    common = common_columns([*lines, *(line for line, _ in others)], columns)
    decimals = decimals_of(lines, paper)
    by_column = [error_cells(lines, [line.spread(column) for line in lines], decimals)
                 for column in columns]
    by_column.append(error_cells(lines, [line.average(common) for line in lines], decimals))
    written = [(*_about(line), *cells) for line, *cells in zip(lines, *by_column)]
    if paper is not None:
        written += [(*_about_published(row), *_published_cells(line, row, columns, common, paper))
                    for line, row in others]
    return Table(f'ATE [m] on {dataset}',
                 ('Method', 'Keyframe', 'Post-Processing', *columns, 'Avg'), tuple(written),
                 (*notes, *average_notes(columns, common), *failure_notes(written),
                  *(published().caveats if others else ())), words=3,
                 total=True,
                 rules=rules_between(sum(line.looks for line in lines), len(lines), len(written)))


def error_cells(lines: Sequence[MethodResults], spreads: Sequence[Spread | None],
                decimals: int) -> list[Cell]:
    """Return a column of errors: the best marked, or else what is worse than seeing nothing."""
    blind = min((spread.median for line, spread in zip(lines, spreads)
                 if spread and not line.looks), default=math.inf)
    ranked = marks([spread.median if spread and line.looks else None
                    for line, spread in zip(lines, spreads)], decimals)
    return [Cell(NONE) if spread is None
            else Cell(spread.text(decimals) + FAILED) if line.looks and spread.median > blind
            else Cell(spread.text(decimals), mark)
            for line, spread, mark in zip(lines, spreads, ranked)]


def decimals_of(lines: Sequence[MethodResults], paper: PublishedTable | None) -> int:
    """Return the paper's decimals, or more where the smallest of our errors has no two digits."""
    smallest = min((spread.median for line in lines if line.looks
                    for spread in map(line.spread, line.values) if spread and spread.median > 0.0),
                   default=1.0)
    needed = 1 - math.floor(math.log10(smallest))
    return min(max(paper.decimals if paper else DECIMALS, needed), MOST_DECIMALS)


def average_notes(columns: Sequence[str], common: Sequence[str]) -> list[str]:
    """Say over what an average is, unless it is over all."""
    if len(common) == len(columns):
        return []
    return [f'Avg: over {", ".join(common)}, which all rows have.' if common else
            'No Avg: no sequence is in all rows.']


def failure_notes(written: Sequence[Sequence[Cell]]) -> list[str]:
    """Say what the sign of a failure means, where there is one."""
    return [FAILURE] * any(cell.text.endswith(FAILED) for row in written for cell in row)


def _published_lines(paper: PublishedTable | None, columns: Sequence[str]
                     ) -> list[tuple[MethodResults, PublishedRow]]:
    """Return what the paper says of these columns, nothing if it says nothing."""
    if paper is None or not set(columns) & set(paper.sequences):
        return []
    return [(MethodResults(row.method, {column: {None: error}
                                        for column, error in zip(paper.sequences, row.errors)
                                        if column in columns}), row) for row in paper.rows]


def _published_cells(line: MethodResults, row: PublishedRow, columns: Sequence[str],
                     common: Sequence[str], paper: PublishedTable) -> list[Cell]:
    spreads = [*map(line.spread, columns), line.average(common)]
    cells = [Cell(spread.text(paper.decimals) if spread else NONE) for spread in spreads]
    if set(common) == set(paper.sequences):
        cells[-1] = Cell(f'{row.average:.{paper.decimals}f}')
    return cells


def _about(line: MethodResults) -> tuple[Cell, ...]:
    name = Cell(label_of(line.method))
    if not line.looks:
        return name, Cell(NONE), Cell(NONE)
    return name, Cell(NO if line.method == EVERY else YES), Cell(NOT_NEEDED)


def _about_published(row: PublishedRow) -> tuple[Cell, ...]:
    return (Cell(f'{row.method} (published)'), Cell(YES if row.keyframes else NO),
            Cell(NEEDED if row.post_processing else NOT_NEEDED))


def strategy_table(by_dataset: dict[str, list[Row]], notes: Sequence[str], whole: bool) -> Table:
    """Return average ATE and keyframes of each method by dataset, with the paper's averages.

    Ours are over the sequences that all methods have, those of the paper over all there are:
    they are left out unless `whole`, and beside sequences that the paper has not.
    """
    methods = methods_of(row for rows in by_dataset.values() for row in rows)
    by_column, over = [], []
    for dataset, rows in by_dataset.items():
        lines = collect_results(rows, methods, 'ate_rmse_m')
        common = common_columns(lines, columns_of(rows))
        decimals = decimals_of(lines, published().ate.get(dataset))
        by_column += [error_cells(lines, [line.average(common) for line in lines], decimals),
                      _kept(rows, methods)]
        over.append(f'{dataset}: {", ".join(common) or "none"}')
    written = [(Cell(label_of(method)), *cells) for method, *cells in zip(methods, *by_column)]
    others = _published_rows(by_dataset) if whole else []
    more = [f'Averages are over the sequences that all rows have ({"; ".join(over)})'
            + (', published ones over all of the paper.' if others else '.')]
    if others:
        more.append(', '.join(SAME.format(each.method, each.ours)
                              for each in published().strategies) + '.')
    head = [name for dataset in by_dataset for name in (dataset, f'{dataset} kept')]
    looking = len(set(methods) - set(TRIVIAL))
    return Table('Keyframe strategies: average ATE [m], and frames kept [%]', ('Method', *head),
                 (*written, *others), (*notes, *more, *failure_notes(written)),
                 rules=rules_between(looking, len(methods), len(written) + len(others)))


def ablation_table(rows: Sequence[Row]) -> Table:
    """Return the paper's ablation on EuRoC, beside those of our averages that belong there."""
    lines = collect_results(rows, methods_of(rows), 'ate_rmse_m')
    common = common_columns(lines, columns_of(rows))
    averages = {line.method: line.average(common) for line in lines}
    written = []
    for each in published().ablation:
        ours = averages.get(each.ours or '')
        written.append((Cell(f'{each.method} (published)'),
                        Cell(number(each.averages[EUROC], ABLATION_DECIMALS)),
                        Cell(each.ours if ours and each.ours else NONE),
                        Cell(ours.text(ABLATION_DECIMALS) if ours else NONE)))
    return Table('Ablation: average ATE [m] on EuRoC', ('Method', 'Avg', 'Here', 'Avg here'),
                 tuple(written), (ABLATION_NOTE, f'Here: over {", ".join(common) or "none"}.'))


def _kept(rows: Sequence[Row], methods: Sequence[str]) -> list[Cell]:
    """Return the share of the frames that each method keeps, the mean over the sequences."""
    spreads = [line.average(tuple(line.values))
               for line in collect_results(rows, methods, 'kept_percent')]
    return [Cell(number(spread.median if spread else None, KEPT_DECIMALS)) for spread in spreads]


def _published_rows(by_dataset: dict[str, list[Row]]) -> list[tuple[Cell, ...]]:
    """Return the paper's averages, nothing where it has none of these datasets."""
    paper = published()
    present = {dataset: paper.has_all(dataset, columns_of(rows))
               for dataset, rows in by_dataset.items()}
    rows: list[tuple[Cell, ...]] = []
    for each in paper.strategies if any(present.values()) else ():
        cells = [Cell(f'{each.method} (published)')]
        for dataset, is_there in present.items():
            average = number(each.averages[dataset], paper.ate[dataset].decimals) \
                if is_there else NONE
            cells += [Cell(average), Cell(NONE)]
        rows.append(tuple(cells))
    return rows


def error_table(rows: Sequence[Row]) -> Table:
    """Return medians over the seeds of every error, a row for each sequence and method."""
    written, ends = [], []
    for sequence in dict.fromkeys(row.sequence for row in rows):
        runs = [row for row in rows if row.sequence == sequence and row.status == FINISHED]
        for method in methods_of(runs):
            cells = [_median(runs, method, name, decimals) for _, name, decimals in ERRORS]
            written.append((Cell(sequence), Cell(label_of(method)), *cells))
        ends.append(len(written))
    return Table('All errors', ('Sequence', 'Method', *(head for head, _, _ in ERRORS)),
                 tuple(written), ERROR_NOTES, words=2, rules=rules_between(*ends))


def runtime_table(by_dataset: dict[str, list[Row]], whole: bool) -> Table:
    """Return how long the parts of a frame took [ms], by dataset, beside the paper's."""
    written: list[tuple[Cell, ...]] = []
    ends = []
    for dataset, rows in by_dataset.items():
        runs = [row for row in rows if row.status == FINISHED and row.method not in TRIVIAL]
        written += [(Cell(dataset), Cell(method), *(
            _median(runs, method, name, STEP_DECIMALS) for _, name in STEPS))
            for method in methods_of(runs)]
        ends.append(len(written))
    paper = published().runtime
    if whole and paper['dataset'] in by_dataset:
        parts = (paper['aggregator'], paper['head'], paper['decide'], paper['total'], None)
        written.append((Cell(paper['dataset']), Cell('Ours (published)'),
                        *(Cell(number(each, STEP_DECIMALS)) for each in parts)))
    notes = [*STEP_NOTES, *_machines(row for rows in by_dataset.values() for row in rows)]
    if len(written) > ends[-1]:
        notes.append(PUBLISHED_NOTE)
    return Table('Time of a frame [ms]', ('Dataset', 'Method', *(head for head, _ in STEPS)),
                 tuple(written), tuple(notes), words=2,
                 rules=rules_between(*ends, len(written)))


def _median(rows: Iterable[Row], method: str, name: str, decimals: int) -> Cell:
    values = [getattr(row, name) for row in rows if row.method == method]
    present = [value for value in values if value is not None]
    return Cell(number(float(np.median(present)) if present else None, decimals))


def _machines(rows: Iterable[Row]) -> list[str]:
    """Return where the runs took place, a line for each kind of place."""
    places = dict.fromkeys((row.machine, row.device, row.jobs) for row in rows
                           if row.machine and row.status == FINISHED)
    return [f'Measured on {machine}{"" if device == "cpu" else f", {device}"}; '
            f'{jobs} {"run" if jobs == 1 else "runs"} side by side.'
            for machine, device, jobs in places]
