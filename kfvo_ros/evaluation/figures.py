# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of many runs: where each of them went, and how its error grew."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation import metrics
from kfvo_ros.evaluation.plots import (
    COLOURS,
    Overlay,
    draw_overlay,
    in_metres,
    lay_over,
    save,
    tidy,
)
from kfvo_ros.trajectory import NANOSECONDS, Trajectory

HEADING, LEGEND, DECORATION = 0.3, 0.35, 0.9
"""Heights [in]: a sequence's name, the legend, and the title and numbers around a panel."""
FLATTEST, STEEPEST = 0.5, 1.1
"""Height by width of a panel, whatever the trajectory in it."""
COMPARABLE = 10.0
"""Errors that differ by more than this factor are drawn on a logarithmic axis."""


@dataclass(frozen=True)
class Panel:
    """One run: its estimate, the truth and the stamps (K,) of the keyframes."""

    sequence: str
    method: str
    estimate: Trajectory
    truth: Trajectory
    keyframes_ns: np.ndarray


@dataclass(frozen=True)
class PlotRange:
    """What all panels of a sequence show: the plane of two axes of the world, across and up.

    ``low`` and ``high`` (2,) are its limits [m].
    """

    plane: tuple[int, int]
    low: np.ndarray
    high: np.ndarray

    @property
    def steepness(self) -> float:
        """Height by width."""
        width, height = self.high - self.low
        return float(height / width)


def draw_trajectories(path: Path, panels: Sequence[Panel]) -> None:
    """Write the picture of `figure_of_trajectories` as PNG."""
    save(figure_of_trajectories(panels), path)


def draw_errors(path: Path, panels: Sequence[Panel]) -> None:
    """Write the picture of `figure_of_errors` as PNG."""
    save(figure_of_errors(panels), path)


def figure_of_trajectories(panels: Sequence[Panel]) -> Figure:
    """Draw a row for each sequence and a panel for each method; expects one run at least.

    Truth red, estimate blue and aligned by Sim(3), in the plane in which the truth spreads most.
    What a method did not do, or what has no ATE, says so in its panel.
    """
    laid = {(each.sequence, each.method): _overlay_or_reason(each) for each in panels}
    sequences = tuple(dict.fromkeys(sequence for sequence, _ in laid))
    methods = tuple(dict.fromkeys(method for _, method in laid))
    views = [_view([laid[key] for key in laid if key[0] == name]) for name in sequences]
    width = float(np.clip(10.0 / len(methods), 3.4, 6.0))
    heights = [width * view.steepness + DECORATION for view in views]
    figure = Figure((width * len(methods) + 0.5,
                     LEGEND + sum(heights) + HEADING * len(heights)), layout='constrained')
    grid = figure.add_gridspec(1 + 2 * len(sequences), len(methods), height_ratios=[
        LEGEND, *(part for height in heights for part in (HEADING, height))])
    for row, (sequence, view) in enumerate(zip(sequences, views, strict=True)):
        _write(figure.add_subplot(grid[2 * row + 1, :]), sequence, weight='bold', size='large')
        contents = {method: laid.get((sequence, method), 'no result') for method in methods}
        _draw_row([figure.add_subplot(grid[2 * row + 2, column])
                   for column in range(len(methods))], contents, view)
    _legend_of_all(figure.add_subplot(grid[0, :]), figure.axes)
    return figure


def figure_of_errors(panels: Sequence[Panel]) -> Figure:
    """Draw error over time, axes for each sequence and a line for each method; expects one run.

    Distance to the truth [m] after alignment by Sim(3); a method without ATE has no line.
    """
    by_sequence: dict[str, list[Panel]] = {}
    for panel in panels:
        by_sequence.setdefault(panel.sequence, []).append(panel)
    methods = dict.fromkeys(panel.method for panel in panels)
    colours = {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(methods)}
    columns = 1 if len(by_sequence) == 1 else 2
    rows = -(-len(by_sequence) // columns)
    figure = Figure((7.5 * columns, 2.7 * rows + 0.3), layout='constrained')
    for number, (sequence, runs) in enumerate(by_sequence.items(), 1):
        axes = figure.add_subplot(rows, columns, number)
        axes.set_title(sequence, loc='left', weight='bold')
        _draw_lines(axes, runs, colours)
    return figure


def _overlay_or_reason(panel: Panel) -> Overlay | str:
    """Return what there is to draw, or in words why there is nothing."""
    try:
        return lay_over(panel.estimate, panel.truth, panel.keyframes_ns)
    except KfvoError as problem:
        return f'no ATE: {problem}'


def _view(row: Sequence[Overlay | str]) -> PlotRange:
    """Return the view that shows truth and estimates of a sequence whole."""
    overlays = [each for each in row if isinstance(each, Overlay)]
    if not overlays:
        return PlotRange((0, 1), np.zeros(2), np.array([1.0, FLATTEST]))
    spread = np.var(np.concatenate([each.truth for each in overlays]), axis=0)
    across, up = sorted(np.argsort(spread, kind='stable')[1:].tolist())
    shown = np.concatenate([positions[:, (across, up)] for each in overlays
                            for positions in (each.truth, each.estimate)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    width, height = 1.1 * (high - low)
    width = max(width, height / STEEPEST)
    half = 0.5 * np.array([width, max(height, FLATTEST * width)])
    centre = 0.5 * (low + high)
    return PlotRange((across, up), centre - half, centre + half)


def _draw_row(row: Sequence[Any], contents: dict[str, Overlay | str], view: PlotRange) -> None:
    """Draw the runs on one sequence, or write why there are none; the first has the numbers."""
    drawn = []
    for axes, (method, content) in zip(row, contents.items(), strict=True):
        if isinstance(content, str):
            axes.set_title(method, size='medium')
            _write(axes, textwrap.fill(content, 45), 'center', color='grey', size='small')
            continue
        draw_overlay(axes, content, view.plane)
        axes.update_datalim([view.low, view.high])  # fixed limits would fight the equal aspect
        axes.margins(0.0)
        axes.locator_params(axis='x', nbins=5)  # room for numbers of many digits
        axes.set_title(f'{method}\n{content.caption}', size='medium')
        drawn.append(axes)
    for axes in drawn[1:]:
        axes.set_ylabel('')
        axes.tick_params(labelleft=False)


def _draw_lines(axes: Any, runs: Sequence[Panel], colours: dict[str, str]) -> None:
    """Draw the errors of all methods on one sequence."""
    tidy(axes)
    rmse, reasons = [], []
    for run in runs:
        try:
            error = metrics.absolute_trajectory_error(run.estimate, run.truth)
        except KfvoError as problem:
            reasons.append(textwrap.fill(f'{run.method}: no ATE: {problem}', 90))
            continue
        seconds = (error.stamps_ns - run.estimate.stamps_ns.min()) / NANOSECONDS
        axes.plot(seconds, error.errors, color=colours[run.method], linewidth=1.2,
                  label=f'{run.method}, ATE {in_metres(error.rmse)}')
        rmse.append(error.rmse)
    if not rmse:
        _write(axes, '\n'.join(reasons), color='grey', size='small')
        return
    axes.set(xlabel='time [s]', ylabel='position error [m]')
    if max(rmse) > COMPARABLE * min(rmse) > 0.0:
        axes.set(yscale='log')
        axes.set_ylim(bottom=0.1 * min(rmse))
        axes.yaxis.set_major_formatter('{x:g}')
    else:
        axes.set_ylim(bottom=0.0)
    axes.legend(loc='upper left', bbox_to_anchor=(1.01, 1.0), frameon=False)


def _write(axes: Any, text: str, place: Literal['left', 'center'] = 'left',
           **style: Any) -> None:
    """Write text where axes would be."""
    axes.axis('off')
    axes.text({'left': 0.0, 'center': 0.5}[place], 0.5, text, horizontalalignment=place,
              verticalalignment='center', transform=axes.transAxes, **style)


def _legend_of_all(axes: Any, drawn: Sequence[Any]) -> None:
    """Draw the legend that all panels share."""
    axes.axis('off')
    entries: dict[str, Any] = {}
    for each in drawn:
        handles, labels = each.get_legend_handles_labels()
        entries |= zip(labels, handles, strict=True)
    if entries:
        axes.legend(entries.values(), entries.keys(), loc='center', ncols=len(entries),
                    frameon=False)
