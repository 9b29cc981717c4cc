# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The report of an ablation: results as CSV and table, and the learning curves."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from kfvo_ros.evaluation.plots import COLOURS, save_figure, style_axes
from kfvo_ros.utils.files import atomic_write

CSV, MARKDOWN, CURVES = 'ablation.csv', 'ablation.md', 'curves.png'
FULL = 'full'
"""The row that all others are compared with."""
TABLE_HEAD = f"""\
| row | ATE, % of the path (min, max) | keyframes kept | against `{FULL}` |
|---|---:|---:|---|
"""
LEGEND = f"""
ATE: RMSE over all frames after Sim(3), geometric mean over {{sequences}} sequences that were not
trained on; median over the seeds, with minimum and maximum in brackets. Keyframes: mean over the
sequences. `none`: the medians of the row and of `{FULL}` differ by no more than the larger of the
two ranges from minimum to maximum; one seed of a training has no range.
"""
ERROR, RETURN = 'validation_ate_percent/', 'rollout/ep_rew_mean'
"""Tags of the logs for TensorBoard."""
LINE_STYLES = {'every': ':', 'optical_flow': '--', 'survival': '-.', 'teacher': (0, (1, 3))}


@dataclass(frozen=True)
class PolicyResult:
    """Result of one policy on one sequence.

    ``seed`` is None where nothing is random; ``ate_percent`` of the path after Sim(3); ``kept``
    is the share of the frames that became keyframes.
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
    has_seeds: bool

    @property
    def median(self) -> float:
        """Median over the seeds."""
        return float(np.median(self.errors))

    @property
    def range(self) -> float | None:
        """Maximum minus minimum over the seeds; None for one seed."""
        if self.has_seeds and len(self.errors) == 1:
            return None
        return max(self.errors) - min(self.errors)

    def compare(self, other: AblationRow) -> str:
        """Return ``better``, ``worse``, ``none`` within the ranges, or nothing without ranges."""
        if self is other or self.range is None or other.range is None:
            return ''
        difference = self.median - other.median
        if abs(difference) <= max(self.range, other.range):
            return 'none'
        return 'better' if difference < 0.0 else 'worse'


@dataclass(frozen=True)
class LearningCurve:
    """One training of a row, with its ``reward``.

    ``errors`` (N, 2) and ``returns`` (M, 2): steps, and validation ATE [%] or mean return of the
    latest episodes. ``references``: validation ATE [%] of the policies without training.
    """

    row: str
    reward: str
    errors: np.ndarray
    returns: np.ndarray
    references: dict[str, float]


@dataclass
class AblationReport:
    """Files in ``folder`` on the trained policies so far and, below them, the ``references``."""

    folder: Path
    references: list[PolicyResult]
    _results: list[PolicyResult] = field(default_factory=list)
    _curves: list[LearningCurve] = field(default_factory=list)

    @property
    def table(self) -> str:
        """The table in Markdown."""
        return ablation_markdown([*self._results, *self.references])

    @property
    def files(self) -> tuple[Path, ...]:
        """Paths of table, CSV and curves."""
        return tuple(self.folder / name for name in (MARKDOWN, CSV, CURVES))

    def add(self, results: Sequence[PolicyResult], reward: str, logs: Path) -> None:
        """Add the results of a training with this reward and its logs; write all files."""
        self._results += results
        self._curves.append(read_curve(results[0].row, reward, logs))
        write_csv(self.folder / CSV, [*self._results, *self.references])
        with atomic_write(self.folder / MARKDOWN) as draft:
            draft.write_text(self.table, encoding='utf-8', errors='backslashreplace')
        plot_curves(self.folder / CURVES, self._curves)


def write_csv(path: Path, results: Sequence[PolicyResult]) -> None:
    """Write one line per row, seed and sequence; the seed is empty where nothing is random."""
    with atomic_write(path) as draft, draft.open('w', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, [each.name for each in fields(PolicyResult)])
        writer.writeheader()
        writer.writerows(asdict(result) for result in results)


def ablation_markdown(results: Sequence[PolicyResult]) -> str:
    """Return the table, with its rows in the order of the results."""
    rows = [_summarise(name, [each for each in results if each.row == name])
            for name in dict.fromkeys(each.row for each in results)]
    full = next((row for row in rows if row.row == FULL), None)
    lines = [_format(row, row.compare(full) if full else '') for row in rows]
    return TABLE_HEAD + ''.join(lines) + LEGEND.format(
        sequences=len({each.sequence for each in results}))


def _summarise(row: str, results: Iterable[PolicyResult]) -> AblationRow:
    by_seed: dict[int | None, list[PolicyResult]] = {}
    for result in results:
        by_seed.setdefault(result.seed, []).append(result)
    errors = [float(np.exp(np.mean(np.log([each.ate_percent for each in group]))))
              for group in by_seed.values()]
    kept = [float(np.mean([each.kept for each in group])) for group in by_seed.values()]
    return AblationRow(row, tuple(errors), float(np.median(kept)), None not in by_seed)


def _format(row: AblationRow, verdict: str) -> str:
    extremes = f' ({min(row.errors):.3f}, {max(row.errors):.3f})' if row.has_seeds else ''
    return (f'| `{row.row}` | {row.median:.3f}{extremes} | {100.0 * row.kept:.0f} % '
            f'| {verdict} |\n')


def read_curve(row: str, reward: str, folder: Path) -> LearningCurve:
    """Read the logs of a training; of a step that was repeated the last value counts."""
    logs = EventAccumulator(str(folder)).Reload()

    def scalars(tag: str) -> np.ndarray:
        """Return steps and values (N, 2)."""
        events = logs.Scalars(tag) if tag in logs.Tags()['scalars'] else []
        return np.array(sorted({each.step: each.value for each in events}.items())).reshape(-1, 2)

    references = {name: scalars(ERROR + name) for name in LINE_STYLES}
    return LearningCurve(row, reward, scalars(f'{ERROR}learned'), scalars(RETURN),
                         {name: each[-1, 1] for name, each in references.items() if len(each)})


def plot_curves(path: Path, curves: Sequence[LearningCurve]) -> None:
    """Plot validation error and returns over steps as PNG: seeds thin, their median bold.

    Returns of different rewards are not comparable, so each reward has its own axes.
    """
    rewards = tuple(dict.fromkeys(curve.reward for curve in curves))
    rows = tuple(dict.fromkeys(curve.row for curve in curves))
    colours = {row: COLOURS[index % len(COLOURS)] for index, row in enumerate(rows)}
    figure = Figure(figsize=(5.5 * (1 + len(rewards)) + 1.5, 5.0),
                    layout=ConstrainedLayoutEngine(w_pad=0.15))
    first, *others = figure.subplots(1, 1 + len(rewards), squeeze=False)[0]
    _draw(first, colours, [(curve.row, curve.errors) for curve in curves])
    for name, error in curves[0].references.items():
        first.axhline(error, color='grey', linestyle=LINE_STYLES[name], linewidth=1.2, label=name)
    first.set(title='validation', yscale='log', ylabel='ATE after Sim(3) [% of the path]')
    first.yaxis.set(major_locator=LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0)),
                    major_formatter='{x:g}', minor_formatter='')
    for axes, reward in zip(others, rewards, strict=True):
        _draw(axes, colours,
              [(curve.row, curve.returns) for curve in curves if curve.reward == reward])
        axes.set(title=f'episodes, {reward} reward', ylabel='mean return of an episode')
    handles, labels = first.get_legend_handles_labels()
    (others or [first])[-1].legend(handles, labels, loc='upper left', bbox_to_anchor=(1.02, 1.0),
                                   frameon=False)
    save_figure(figure, path)


def _draw(axes: Any, colours: dict[str, str], lines: Sequence[tuple[str, np.ndarray]]) -> None:
    for row in dict.fromkeys(row for row, _ in lines):
        seeds = [values for name, values in lines if name == row and len(values)]
        for values in seeds:
            axes.plot(*values.T, color=colours[row], linewidth=0.7, alpha=0.5)
        axes.plot(*_median_curve(seeds), color=colours[row], linewidth=2.2, marker='.',
                  markersize=4.0, label=row)
    axes.set(xlabel='training decisions')
    style_axes(axes)


def _median_curve(seeds: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and median of curves (N, 2), over the steps that all of them cover.

    The points of an interrupted training are at other steps, so curves are interpolated.
    """
    if not seeds:
        return np.zeros(0), np.zeros(0)
    first, last = max(each[0, 0] for each in seeds), min(each[-1, 0] for each in seeds)
    steps = np.unique(np.concatenate([each[:, 0] for each in seeds]))
    steps = steps[(first <= steps) & (steps <= last)]
    return steps, np.median([np.interp(steps, *each.T) for each in seeds], axis=0)
