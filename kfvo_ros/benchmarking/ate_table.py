# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ATE table of a dataset, in the paper's layout, with the paper's rows."""

from __future__ import annotations

import math
from collections.abc import Sequence

from kfvo_ros.benchmarking.lines import (
    Line,
    Spread,
    columns_of,
    common_columns,
    label_of,
    lines_of,
    methods_of,
)
from kfvo_ros.benchmarking.published import PublishedRow, PublishedTable, published
from kfvo_ros.benchmarking.rows import Row
from kfvo_ros.benchmarking.tables import NO, NONE, YES, Cell, Table, marks, rules_between

DECIMALS, MOST_DECIMALS = 3, 6
NEEDED, NOT_NEEDED = 'Required', 'No'
EVERY = 'every'
FAILED = ' †'
FAILURE = '† worse than constant position or a straight line, which see nothing: it failed.'


def ate_table(dataset: str, rows: Sequence[Row], notes: Sequence[str], whole: bool) -> Table:
    """Return the table of these rows, all of the dataset.

    Published rows are of whole sequences: they are left out unless `whole`. Averages are over the
    sequences that all rows have. Best and second best are marked among the methods run here.
    """
    columns, lines = columns_of(rows), lines_of(rows, methods_of(rows), 'ate_rmse_m')
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


def error_cells(lines: Sequence[Line], spreads: Sequence[Spread | None],
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


def decimals_of(lines: Sequence[Line], paper: PublishedTable | None) -> int:
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
                     ) -> list[tuple[Line, PublishedRow]]:
    """Return what the paper says of these columns, nothing if it says nothing."""
    if paper is None or not set(columns) & set(paper.sequences):
        return []
    return [(Line(row.method, {column: {None: error}
                               for column, error in zip(paper.sequences, row.errors)
                               if column in columns}), row) for row in paper.rows]


def _published_cells(line: Line, row: PublishedRow, columns: Sequence[str],
                     common: Sequence[str], paper: PublishedTable) -> list[Cell]:
    spreads = [*map(line.spread, columns), line.average(common)]
    cells = [Cell(spread.text(paper.decimals) if spread else NONE) for spread in spreads]
    if set(common) == set(paper.sequences):
        cells[-1] = Cell(f'{row.average:.{paper.decimals}f}')
    return cells


def _about(line: Line) -> tuple[Cell, ...]:
    name = Cell(label_of(line.method))
    if not line.looks:
        return name, Cell(NONE), Cell(NONE)
    return name, Cell(NO if line.method == EVERY else YES), Cell(NOT_NEEDED)


def _about_published(row: PublishedRow) -> tuple[Cell, ...]:
    return (Cell(f'{row.method} (published)'), Cell(YES if row.keyframes else NO),
            Cell(NEEDED if row.post_processing else NOT_NEEDED))
