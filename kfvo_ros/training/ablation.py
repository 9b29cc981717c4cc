# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rows of the ablation: what of a recipe each of them changes."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.keyframes.learned import read_policy
from kfvo_ros.training.checkpoint import changes, read_checkpoint
from kfvo_ros.training.config import TrainingConfig
from kfvo_ros.training.plan import SUFFIX, TrainingFiles, TrainingPlan
from kfvo_ros.training.rewards import ALPHA
from kfvo_ros.utils.files import atomic_write

FULL = 'full'
VALIDATIONS = 8
"""A learning curve has so many points or more."""
_PAPER: dict[str, Any] = {'reward': 'paper', 'alpha': ALPHA, 'without': ('signals',),
                          'teacher': None}
ROWS: dict[str, dict[str, Any]] = {
    FULL: _PAPER,
    'without_pose': _PAPER | {'without': ('poses', 'signals')},
    'without_descriptor': _PAPER | {'without': ('descriptor', 'signals')},
    'without_alpha': _PAPER | {'alpha': 0.0},
    'alpha_penalty': _PAPER | {'alpha': -ALPHA},
    'local': {'reward': 'local', 'without': ()},
    'local_signals_only': {'reward': 'local', 'without': ('descriptor', 'poses')},
    'local_untaught': {'reward': 'local', 'without': ('descriptor', 'poses'), 'teacher': None},
}
"""Rows against `FULL`, which is reward and observation of the paper: the mean descriptor and the
relative poses, not the backbone's signals; and our own reward on all that can be seen, on the
signals alone, and from nothing instead of from a teacher."""
TABLE_HEAD = f"""\
| row | ATE, % of the path (min, max) | keyframes kept | against `{FULL}` |
|---|---:|---:|---|
"""
LEGEND = f"""
ATE: RMSE over all frames after Sim(3), geometric mean over {{sequences}} sequences that nobody
learned from; median over the seeds, the smallest and the largest in brackets. Keyframes: mean
over the sequences. `none`: the medians of the row and of `{FULL}` differ by no more than the
larger of the two spreads, from smallest to largest; one seed of a training tells no spread.
"""


def row_config(name: str, recipe: TrainingConfig, steps: int) -> TrainingConfig:
    """Return the recipe of a row, of so many steps, validated often enough for a curve."""
    every = min(recipe.validation_every, max(steps // VALIDATIONS, 1))
    return replace(recipe, steps=steps, validation_every=every, **ROWS[name])


@dataclass(frozen=True)
class PolicyResult:
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
class AblationRow:
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

    def against(self, other: AblationRow) -> str:
        """Return in a word whether this one is better, as far as the seeds tell."""
        if self is other or self.spread is None or other.spread is None:
            return ''
        difference = self.median - other.median
        if abs(difference) <= max(self.spread, other.spread):
            return 'none'
        return 'better' if difference < 0.0 else 'worse'


def write_csv(path: Path, outcomes: Sequence[PolicyResult]) -> None:
    """Write one line per row, seed and sequence; the seed is empty where nothing was drawn."""
    with atomic_write(path) as draft, draft.open('w', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, [each.name for each in fields(PolicyResult)])
        writer.writeheader()
        writer.writerows(asdict(outcome) for outcome in outcomes)


def write_markdown(path: Path, outcomes: Sequence[PolicyResult]) -> None:
    """Write the table, for people."""
    with atomic_write(path) as draft:
        draft.write_text(ablation_markdown(outcomes), encoding='utf-8')


def ablation_markdown(outcomes: Sequence[PolicyResult]) -> str:
    """Return the table, in the order in which the rows came."""
    lines = [_line(row, [each for each in outcomes if each.row == row])
             for row in dict.fromkeys(each.row for each in outcomes)]
    full = next((line for line in lines if line.row == FULL), None)
    legend = LEGEND.format(sequences=len({each.sequence for each in outcomes}))
    return TABLE_HEAD + ''.join(_format(line, line.against(full) if full else '')
                                for line in lines) + legend


def _line(row: str, outcomes: Iterable[PolicyResult]) -> AblationRow:
    by_seed: dict[int | None, list[PolicyResult]] = {}
    for outcome in outcomes:
        by_seed.setdefault(outcome.seed, []).append(outcome)
    errors = [float(np.exp(np.mean(np.log([each.ate_percent for each in group]))))
              for group in by_seed.values()]
    kept = [float(np.mean([each.kept for each in group])) for group in by_seed.values()]
    return AblationRow(row, tuple(errors), float(np.median(kept)), drawn=None not in by_seed)


def _format(line: AblationRow, verdict: str) -> str:
    extremes = f' ({min(line.errors):.3f}, {max(line.errors):.3f})' if line.drawn else ''
    return (f'| `{line.row}` | {line.median:.3f}{extremes} | {100.0 * line.kept:.0f} % '
            f'| {verdict} |\n')


@dataclass(frozen=True)
class TrainingRun:
    """The ``plan`` of a ``row`` and a seed, with all others in one folder."""

    row: str
    plan: TrainingPlan
    folder: Path

    @property
    def seed(self) -> int:
        """The training's."""
        return self.plan.seed

    @property
    def files(self) -> TrainingFiles:
        """What the training writes."""
        return TrainingFiles(str(self.folder / f'{self.row}-{self.seed}{SUFFIX}'))

    @property
    def recipe_file(self) -> Path:
        """The recipe, which the seeds of a row share."""
        return self.folder / f'{self.row}.yaml'

    def prepare(self, resume: bool) -> None:
        """Make the folder; raises KfvoError at an earlier training, or to `resume` another one."""
        earlier = [path for path in (self.files.output, self.files.folder) if path.exists()]
        if earlier and not resume:
            raise KfvoError(f'{earlier[0]} is there already; choose another --output, or add '
                            '--resume to go on')
        if not self.is_complete():
            if self.files.checkpoint.exists():
                read_checkpoint(self.files.checkpoint, self.plan)
            elif self.files.output.exists():
                raise KfvoError(f'{self.files.output} is of another training, or has lost its '
                                'checkpoint; choose another --output, or remove it')
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error

    def write_recipe(self) -> None:
        """Write the recipe of a training that begins or goes on; raises KfvoError."""
        try:
            with atomic_write(self.recipe_file) as draft:
                draft.write_text(yaml.safe_dump(asdict(self.plan.recipe), sort_keys=False),
                                 encoding='utf-8')
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error

    def is_complete(self) -> bool:
        """Whether all that was learned already, for as many steps; raises KfvoError."""
        if not (self.files.output.exists() and self.files.last.exists()):
            return False
        wanted = json.loads(json.dumps(asdict(self.plan)))
        told = read_policy(self.files.last).training
        return (told.get('steps', 0) >= self.plan.recipe.steps
                and not any(changes({name: value for name, value in told.items()
                                     if name in wanted}, wanted)))
