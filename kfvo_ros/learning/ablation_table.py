# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What came of an ablation, as CSV and as the table that people read."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from kfvo_ros.atomic import replaced
from kfvo_ros.learning.ablation_rows import FULL

HEAD = f"""\
| row | ATE, % of the path (min, max) | keyframes kept | against `{FULL}` |
|---|---:|---:|---|
"""
LEGEND = f"""
ATE: RMSE over all frames after Sim(3), geometric mean over {{sequences}} sequences that nobody
learned from; median over the seeds, the smallest and the largest in brackets. Keyframes: mean
over the sequences. `none`: the medians of the row and of `{FULL}` differ by no more than the
larger of the two spreads, from smallest to largest; one seed of a training tells no spread.
"""


@dataclass(frozen=True)
class Outcome:
    """How one policy did on one sequence.

    ``seed`` None: nothing in it was drawn; ``ate_percent`` of the path after Sim(3); ``kept``:
    share of the frames that became keyframes.
    """

    row: str
    seed: int | None
    sequence: str
    ate_percent: float
    kept: float


@dataclass(frozen=True)
class Line:
    """A row of the table: geometric mean of the ATE [%] for each seed, and the share kept."""

    row: str
    errors: tuple[float, ...]
    kept: float
    drawn: bool

    @property
    def median(self) -> float:
        """The median over the seeds."""
        return float(np.median(self.errors))

    @property
    def spread(self) -> float | None:
        """From the smallest to the largest; None where one seed cannot tell."""
        if self.drawn and len(self.errors) == 1:
            return None
        return max(self.errors) - min(self.errors)

    def against(self, other: Line) -> str:
        """Return in a word whether this one is better, as far as the seeds tell."""
        if self is other or self.spread is None or other.spread is None:
            return ''
        difference = self.median - other.median
        if abs(difference) <= max(self.spread, other.spread):
            return 'none'
        return 'better' if difference < 0.0 else 'worse'


def write_csv(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write one line per row, seed and sequence; the seed is empty where nothing was drawn."""
    with replaced(path) as draft, draft.open('w', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, [each.name for each in fields(Outcome)])
        writer.writeheader()
        writer.writerows(asdict(outcome) for outcome in outcomes)


def write_markdown(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write the table, for people."""
    with replaced(path) as draft:
        draft.write_text(markdown(outcomes), encoding='utf-8')


def markdown(outcomes: Sequence[Outcome]) -> str:
    """Return the table, in the order in which the rows came."""
    lines = [_line(row, [each for each in outcomes if each.row == row])
             for row in dict.fromkeys(each.row for each in outcomes)]
    full = next((line for line in lines if line.row == FULL), None)
    legend = LEGEND.format(sequences=len({each.sequence for each in outcomes}))
    return HEAD + ''.join(_format(line, line.against(full) if full else '')
                          for line in lines) + legend


def _line(row: str, outcomes: Iterable[Outcome]) -> Line:
    by_seed: dict[int | None, list[Outcome]] = {}
    for outcome in outcomes:
        by_seed.setdefault(outcome.seed, []).append(outcome)
    errors = [float(np.exp(np.mean(np.log([each.ate_percent for each in group]))))
              for group in by_seed.values()]
    kept = [float(np.mean([each.kept for each in group])) for group in by_seed.values()]
    return Line(row, tuple(errors), float(np.median(kept)), drawn=None not in by_seed)


def _format(line: Line, verdict: str) -> str:
    extremes = f' ({min(line.errors):.3f}, {max(line.errors):.3f})' if line.drawn else ''
    return (f'| `{line.row}` | {line.median:.3f}{extremes} | {100.0 * line.kept:.0f} % '
            f'| {verdict} |\n')
