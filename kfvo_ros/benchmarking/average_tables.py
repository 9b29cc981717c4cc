# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Averages over datasets: the keyframe strategies, and the paper's ablation."""

from __future__ import annotations

from collections.abc import Sequence

from kfvo_ros.benchmarking.ate_table import decimals_of, error_cells, failure_notes
from kfvo_ros.benchmarking.lines import (
    columns_of,
    common_columns,
    label_of,
    lines_of,
    methods_of,
)
from kfvo_ros.benchmarking.published import published
from kfvo_ros.benchmarking.rows import TRIVIAL, Row
from kfvo_ros.benchmarking.subjects import EUROC
from kfvo_ros.benchmarking.tables import NONE, Cell, Table, number, rules_between

KEPT_DECIMALS, ABLATION_DECIMALS = 1, 3
ABLATION_NOTE = ('The paper\'s rows, trained for VGGT; `python -m kfvo_ros.ablation` trains such '
                 'rows for the geometric backbone.')
SAME = '{} is {}'


def strategy_table(by_dataset: dict[str, list[Row]], notes: Sequence[str], whole: bool) -> Table:
    """Return average ATE and keyframes of each method by dataset, with the paper's averages.

    Ours are over the sequences that all methods have, those of the paper over all there are:
    they are left out unless `whole`, and beside sequences that the paper has not.
    """
    methods = methods_of(row for rows in by_dataset.values() for row in rows)
    by_column, over = [], []
    for dataset, rows in by_dataset.items():
        lines = lines_of(rows, methods, 'ate_rmse_m')
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
    lines = lines_of(rows, methods_of(rows), 'ate_rmse_m')
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
               for line in lines_of(rows, methods, 'kept_percent')]
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
