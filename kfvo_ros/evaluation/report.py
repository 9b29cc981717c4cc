# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Report of a benchmark: results.md, results.tex, results.html and the plots."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.evaluation.aggregation import columns_of, group_by_dataset
from kfvo_ros.evaluation.plan import EUROC
from kfvo_ros.evaluation.published import published
from kfvo_ros.evaluation.records import FAILED, FINISHED, TRIVIAL, Evaluator, Row
from kfvo_ros.evaluation.render import Table, latex, markdown, write_page
from kfvo_ros.evaluation.results import KEYFRAMES, TRAJECTORY
from kfvo_ros.evaluation.runner import Run
from kfvo_ros.evaluation.tables import (
    ablation_table,
    ate_table,
    error_table,
    runtime_table,
    strategy_table,
)
from kfvo_ros.trajectory import read_tum
from kfvo_ros.utils.files import atomic_write

if TYPE_CHECKING:
    from kfvo_ros.evaluation.plots import PlottedRun

MARKDOWN_PAGE, LATEX, HTML = 'results.md', 'results.tex', 'results.html'
TITLE = 'Results of kfvo_ros'
EXCERPT_NOTE = ('Of each sequence the first {stop} frames only: published rows, which are of '
                'whole sequences, are left out.')
TRAJECTORIES, ERRORS = 'trajectories.png', 'errors.png'
MAX_PLOTTED_SEQUENCES = 11
"""The number of sequences in the largest of the paper's tables; more are not readable."""


@dataclass(frozen=True)
class Provenance:
    """How the results were measured: ``command`` and ``version``.

    ``stop``: only the first frames of each sequence, None for all; ``policy``: description of the
    learned policy, None without one.
    """

    command: str
    version: str
    stop: int | None
    policy: str | None


def make_tables(rows: Sequence[Row], provenance: Provenance) -> tuple[Table, ...]:
    """Return all tables, those of the paper first."""
    by_dataset = group_by_dataset(rows)
    whole = provenance.stop is None
    notes = _notes(rows, provenance)
    tables = [ate_table(dataset, each, (*notes, *_problem_notes(each), *_frame_notes(each)), whole)
              for dataset, each in by_dataset.items()]
    tables += [strategy_table(by_dataset, notes, whole), runtime_table(by_dataset, whole)]
    if whole and EUROC in by_dataset \
            and published().has_all(EUROC, columns_of(by_dataset[EUROC])):
        tables.append(ablation_table(by_dataset[EUROC]))
    return (*tables, error_table(rows))


def write_report(folder: Path, tables: Sequence[Table], figures: Sequence[Path],
                 provenance: Provenance) -> None:
    """Write the Markdown, LaTeX and HTML pages; raises KfvoError."""
    shown = [f'![{figure.stem}]({figure.name})\n' for figure in figures]
    head = (f'# {TITLE}\n\nBy kfvo_ros {provenance.version}; of the methods run here the best is '
            '**bold**, the second best <u>underlined</u>. To make this page again:\n\n'
            f'    {provenance.command}\n')
    try:
        for name, text in ((MARKDOWN_PAGE, '\n'.join((head, *map(markdown, tables), *shown))),
                           (LATEX, latex(tables))):
            with atomic_write(folder / name) as draft:
                draft.write_text(text, encoding='utf-8', errors='backslashreplace')
        write_page(folder / HTML, TITLE, tables, figures)
    except OSError as error:
        raise KfvoError(f'cannot write to {folder}: {reason_of(error)}') from error


def plot_runs(folder: Path, runs: Iterable[Run], evaluator: Evaluator) -> tuple[Path, ...]:
    """Plot trajectories and errors of runs; return the files, () without any. Raises KfvoError.

    Of each sequence and method the first seed with a trajectory.
    """
    from kfvo_ros.evaluation.plots import errors_figure, save_figure, trajectories_figure
    plotted = list(_plotted_runs(runs, evaluator))
    sequences = tuple(dict.fromkeys(run.sequence for run in plotted))[:MAX_PLOTTED_SEQUENCES]
    plotted = [run for run in plotted if run.sequence in sequences]
    if not plotted:
        return ()
    try:
        save_figure(trajectories_figure(plotted), folder / TRAJECTORIES)
        save_figure(errors_figure(plotted), folder / ERRORS)
    except OSError as error:
        raise KfvoError(f'cannot write to {folder}: {reason_of(error)}') from error
    return folder / TRAJECTORIES, folder / ERRORS


def _notes(rows: Sequence[Row], provenance: Provenance) -> list[str]:
    """Return the notes that hold for all tables."""
    runs = [row for row in rows if row.method not in TRIVIAL]
    kinds = dict.fromkeys(f'{row.backbone} backbone, scale rule {row.scale_rule}' for row in runs
                          if row.status == FINISHED)
    seeds = sorted({row.seed for row in runs if row.seed is not None})
    drawn = f'median of the seeds {", ".join(map(str, seeds))} (smallest–largest)' \
        if len(seeds) > 1 else f'seed {seeds[0]}'
    notes = [f'Measured here: {"; ".join(kinds) or "nothing"}; {drawn}.']
    if provenance.policy is not None:
        notes.append(f'learned: {provenance.policy}.')
    if provenance.stop is not None:
        notes.append(EXCERPT_NOTE.format(stop=provenance.stop))
    return notes


def _problem_notes(rows: Sequence[Row]) -> list[str]:
    """Return a note for each problem, with the runs that failed or have no error for it."""
    runs_by_problem: dict[str, list[str]] = {}
    for row in rows:
        if row.problem is not None:
            problem = f'{"failed" if row.status == FAILED else "no ATE"}: {row.problem}'
            runs_by_problem.setdefault(problem, []).append(
                f'{row.method} on {row.column}, seed {row.seed}')
    return [f'{"; ".join(runs)}: {problem}' for problem, runs in runs_by_problem.items()]


def _frame_notes(rows: Sequence[Row]) -> list[str]:
    """Return a note for each sequence whose ground truth is not of the camera."""
    frames = {row.column: row.ground_truth_frame for row in rows
              if row.ground_truth_frame not in (None, 'camera')}
    return [f'{column}: the truth is that of {frame}, not of the camera.'
            for column, frame in frames.items()]


def _plotted_runs(runs: Iterable[Run], evaluator: Evaluator) -> Iterator[PlottedRun]:
    """Yield the runs that have a trajectory and ground truth, one per sequence and method."""
    from kfvo_ros.evaluation.plots import PlottedRun
    seen = set()
    for run in runs:
        if (run.sequence, run.method) not in seen:
            with suppress(KfvoError):  # results.csv holds the problem
                truth = evaluator.ground_truth(run.sequence)
                if truth is not None:
                    estimate = read_tum(run.folder / TRAJECTORY)
                    seen.add((run.sequence, run.method))
                    yield PlottedRun(run.sequence.name, run.method, estimate, truth.trajectory,
                                     read_tum(run.folder / KEYFRAMES).stamps_ns)
