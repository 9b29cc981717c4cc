# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pages of a benchmark: results.md, results.tex, results.html and the pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.evaluation.aggregation import columns_of
from kfvo_ros.evaluation.figures import Panel, draw_errors, draw_trajectories
from kfvo_ros.evaluation.published import published
from kfvo_ros.evaluation.records import FAILED, FINISHED, TRIVIAL, Row
from kfvo_ros.evaluation.render import Table, latex, markdown, write_page
from kfvo_ros.evaluation.runner import Run
from kfvo_ros.evaluation.scoring import Evaluator
from kfvo_ros.evaluation.sequences import EUROC
from kfvo_ros.evaluation.tables import (
    ablation_table,
    ate_table,
    error_table,
    runtime_table,
    strategy_table,
)
from kfvo_ros.odometry.results import KEYFRAMES, TRAJECTORY
from kfvo_ros.trajectory import read_tum
from kfvo_ros.utils.files import atomic_write

MARKDOWN_PAGE, LATEX, HTML = 'results.md', 'results.tex', 'results.html'
TITLE = 'Results of kfvo_ros'
EXCERPT_NOTE = ('Of each sequence the first {stop} frames only: published rows, which are of '
                'whole sequences, are left out.')
TRAJECTORIES, ERRORS = 'trajectories.png', 'errors.png'
MOST_SEQUENCES = 11
"""As many as the largest of the paper's tables; more make no picture that can be read."""


@dataclass(frozen=True)
class About:
    """What a page tells of how it came to be.

    ``command`` makes it again; ``stop``: of each sequence so many frames only; ``policy``: what
    the learned policy is, in words, None without one.
    """

    command: str
    version: str
    stop: int | None
    policy: str | None


def make_tables(rows: Sequence[Row], about: About) -> tuple[Table, ...]:
    """Return all tables, those of the paper first."""
    by_dataset: dict[str, list[Row]] = {}
    for row in rows:
        by_dataset.setdefault(str(row.dataset), []).append(row)
    whole = about.stop is None
    notes = _notes(rows, about)
    tables = [ate_table(dataset, each, (*notes, *_problems(each), *_truths(each)), whole)
              for dataset, each in by_dataset.items()]
    tables += [strategy_table(by_dataset, notes, whole), runtime_table(by_dataset, whole)]
    if whole and EUROC in by_dataset \
            and published().has_all(EUROC, columns_of(by_dataset[EUROC])):
        tables.append(ablation_table(by_dataset[EUROC]))
    return (*tables, error_table(rows))


def write_report(folder: Path, tables: Sequence[Table], pictures: Sequence[Path],
                 about: About) -> None:
    """Write the pages; raises KfvoError."""
    shown = [f'![{picture.stem}]({picture.name})\n' for picture in pictures]
    head = (f'# {TITLE}\n\nBy kfvo_ros {about.version}; of the methods run here the best is '
            '**bold**, the second best <u>underlined</u>. To make this page again:\n\n'
            f'    {about.command}\n')
    try:
        for name, text in ((MARKDOWN_PAGE, '\n'.join((head, *map(markdown, tables), *shown))),
                           (LATEX, latex(tables))):
            with atomic_write(folder / name) as draft:
                draft.write_text(text, encoding='utf-8')
        write_page(folder / HTML, TITLE, tables, pictures)
    except OSError as error:
        raise KfvoError(f'cannot write to {folder}: {reason_of(error)}') from error


def _notes(rows: Sequence[Row], about: About) -> list[str]:
    """Say what is true of all tables."""
    runs = [row for row in rows if row.method not in TRIVIAL]
    kinds = dict.fromkeys(f'{row.backbone} backbone, scale rule {row.scale_rule}' for row in runs
                          if row.status == FINISHED)
    seeds = sorted({row.seed for row in runs if row.seed is not None})
    drawn = f'median of the seeds {", ".join(map(str, seeds))} (smallest–largest)' \
        if len(seeds) > 1 else f'seed {seeds[0]}'
    notes = [f'Measured here: {"; ".join(kinds) or "nothing"}; {drawn}.']
    if about.policy is not None:
        notes.append(f'learned: {about.policy}.')
    if about.stop is not None:
        notes.append(EXCERPT_NOTE.format(stop=about.stop))
    return notes


def _problems(rows: Sequence[Row]) -> list[str]:
    """Return a line for each run that failed or has no error, alike ones together."""
    told: dict[str, list[str]] = {}
    for row in rows:
        if row.problem is not None:
            run = f'{row.method} on {row.column}, seed {row.seed}'
            told.setdefault(f'{"failed" if row.status == FAILED else "no ATE"}: {row.problem}',
                            []).append(run)
    return [f'{"; ".join(runs)}: {problem}' for problem, runs in told.items()]


def _truths(rows: Sequence[Row]) -> list[str]:
    """Say where the truth is not of the camera."""
    others = {row.column: row.ground_truth_frame for row in rows
              if row.ground_truth_frame not in (None, 'camera')}
    return [f'{column}: the truth is that of {frame}, not of the camera.'
            for column, frame in others.items()]


def draw(folder: Path, runs: Iterable[Run], examiner: Evaluator) -> tuple[Path, ...]:
    """Draw runs that were scored; return the pictures, none of nothing. Raises KfvoError."""
    panels = list(_panels(runs, examiner))
    drawn = tuple(dict.fromkeys(panel.sequence for panel in panels))[:MOST_SEQUENCES]
    panels = [panel for panel in panels if panel.sequence in drawn]
    if not panels:
        return ()
    try:
        draw_trajectories(folder / TRAJECTORIES, panels)
        draw_errors(folder / ERRORS, panels)
    except OSError as error:
        raise KfvoError(f'cannot write to {folder}: {reason_of(error)}') from error
    return folder / TRAJECTORIES, folder / ERRORS


def _panels(runs: Iterable[Run], examiner: Evaluator) -> Iterator[Panel]:
    seen = set()
    for run in runs:
        if (run.subject, run.method) not in seen:
            with suppress(KfvoError):  # results.csv tells
                truth = examiner.truth(run.subject)
                if truth is not None:
                    estimate = read_tum(run.folder / TRAJECTORY)
                    seen.add((run.subject, run.method))
                    yield Panel(run.subject.name, run.method, estimate, truth.trajectory,
                                read_tum(run.folder / KEYFRAMES).stamps_ns)
