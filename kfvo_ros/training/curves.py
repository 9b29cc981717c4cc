# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Learning curves, from what trainings logged for TensorBoard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from kfvo_ros.evaluation.plots import COLOURS, save, tidy
from kfvo_ros.keyframes import HEURISTICS
from kfvo_ros.training.baselines import ExpertPolicy

ERROR, RETURN = 'validation_ate_percent/', 'rollout/ep_rew_mean'
DASHES = dict(zip((*HEURISTICS, ExpertPolicy.name), (':', '--', '-.', (0, (1, 3))), strict=True))


@dataclass(frozen=True)
class Curve:
    """One training of a row, with its ``reward``.

    ``errors`` (N, 2) and ``returns`` (M, 2): steps, and validation ATE [%] or mean return of the
    latest episodes; ``references``: the ATE [%] of heuristics and teacher on the same validation.
    """

    row: str
    reward: str
    errors: np.ndarray
    returns: np.ndarray
    references: dict[str, float]


def read_curve(row: str, reward: str, folder: Path) -> Curve:
    """Return what a training logged in its folder; of a step done twice the second time counts."""
    logs = EventAccumulator(str(folder)).Reload()

    def values(name: str) -> np.ndarray:
        """Return (N, 2): steps, and what was logged there last."""
        events = logs.Scalars(name) if name in logs.Tags()['scalars'] else []
        return np.array(sorted({each.step: each.value for each in events}.items())).reshape(-1, 2)

    references = {name: values(ERROR + name) for name in DASHES}
    return Curve(row, reward, values(f'{ERROR}learned'), values(RETURN),
                 {name: each[-1, 1] for name, each in references.items() if len(each)})


def plot_curves(path: Path, curves: Sequence[Curve]) -> None:
    """Draw validation error and returns against steps as PNG: thin a seed, bold their median.

    Returns of different rewards cannot be compared: each reward has a picture of its own.
    """
    rewards = tuple(dict.fromkeys(curve.reward for curve in curves))
    rows = tuple(dict.fromkeys(curve.row for curve in curves))
    colours = {row: COLOURS[number % len(COLOURS)] for number, row in enumerate(rows)}
    figure = Figure(figsize=(5.5 * (1 + len(rewards)) + 1.5, 5.0),
                    layout=ConstrainedLayoutEngine(w_pad=0.15))
    first, *others = figure.subplots(1, 1 + len(rewards), squeeze=False)[0]
    _draw(first, colours, [(curve.row, curve.errors) for curve in curves])
    for name, error in curves[0].references.items():
        first.axhline(error, color='grey', linestyle=DASHES[name], linewidth=1.2, label=name)
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
    save(figure, path)


def _draw(axes: Any, colours: dict[str, str], lines: Sequence[tuple[str, np.ndarray]]) -> None:
    for row in dict.fromkeys(row for row, _ in lines):
        seeds = [values for name, values in lines if name == row and len(values)]
        for values in seeds:
            axes.plot(*values.T, color=colours[row], linewidth=0.7, alpha=0.5)
        axes.plot(*_median(seeds), color=colours[row], linewidth=2.2, marker='.', markersize=4.0,
                  label=row)
    axes.set(xlabel='decisions learned from')
    tidy(axes)


def _median(seeds: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and median of curves (N, 2) where all have begun and none has ended.

    One that was interrupted has its points at other steps than the others.
    """
    if not seeds:
        return np.zeros(0), np.zeros(0)
    begin, end = max(each[0, 0] for each in seeds), min(each[-1, 0] for each in seeds)
    steps = np.unique(np.concatenate([each[:, 0] for each in seeds]))
    steps = steps[(begin <= steps) & (steps <= end)]
    return steps, np.median([np.interp(steps, *each.T) for each in seeds], axis=0)
