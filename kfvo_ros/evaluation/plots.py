# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectory plots: one run, or sequences by methods; and the style that all plots share."""

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
from kfvo_ros.trajectory import NANOSECONDS, Trajectory
from kfvo_ros.utils.files import atomic_write

TRUTH, ESTIMATE = '#d62728', '#1f4e9c'
COLOURS = ('#000000', '#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9',
           '#8c564b')
"""Okabe and Ito's palette for the colour-blind, with brown in place of yellow."""
HEADING_IN, LEGEND_IN, DECORATION_IN = 0.3, 0.35, 0.9
"""Heights [in]: a sequence's name, the legend, and the title and numbers around axes."""
MIN_ASPECT, MAX_ASPECT = 0.5, 1.1
"""Height by width of axes, whatever the trajectory in them."""
LOG_SCALE_RATIO = 10.0
"""RMSEs that differ by more than this factor are drawn on a logarithmic axis."""


@dataclass(frozen=True)
class PlottedRun:
    """One run: its estimate, the ground truth and the stamps (K,) of the keyframes."""

    sequence: str
    method: str
    estimate: Trajectory
    truth: Trajectory
    keyframes_ns: np.ndarray


@dataclass(frozen=True)
class Overlay:
    """An estimate aligned by Sim(3): positions (..., 3) in the world of the ground truth [m].

    ``truth`` (M, 3) where the estimate matches it, ``estimate`` (N, 3) and, among it,
    ``keyframes`` (K, 3); ``caption`` states the ATE.
    """

    truth: np.ndarray
    estimate: np.ndarray
    keyframes: np.ndarray
    caption: str


@dataclass(frozen=True)
class PlotRange:
    """What all axes of a sequence show: ``plane``, two axes of the world, across and up.

    ``low`` and ``high`` (2,) are its limits [m].
    """

    plane: tuple[int, int]
    low: np.ndarray
    high: np.ndarray

    @property
    def aspect(self) -> float:
        """Height by width."""
        width, height = self.high - self.low
        return float(height / width)


def plot_trajectory(path: Path, estimate: Trajectory, truth: Trajectory,
                    keyframes_ns: np.ndarray, title: str) -> None:
    """Plot an estimate on the truth (z up, metres), from above and from the side, as PNG.

    Raises KfvoError where there is no ATE.
    """
    overlay = align_overlay(estimate, truth, keyframes_ns)
    figure = Figure(figsize=(10.0, 5.2), layout='constrained')
    figure.suptitle(f'{title}: {overlay.caption}')
    for axes, plane, name in zip(figure.subplots(1, 2), ((0, 1), (0, 2)),
                                 ('from above', 'from the side'), strict=True):
        draw_overlay(axes, overlay, plane)
        axes.set_title(name)
    axes.legend(frameon=False)
    save_figure(figure, path)


def trajectories_figure(runs: Sequence[PlottedRun]) -> Figure:
    """Return a figure with a row for each sequence and a column for each method.

    Truth red, estimate blue and aligned by Sim(3), in the plane in which the truth spreads most.
    Axes of a missing run, or of one without ATE, hold the reason. Expects one run at least.
    """
    overlays = {(run.sequence, run.method): _overlay_or_reason(run) for run in runs}
    sequences = tuple(dict.fromkeys(sequence for sequence, _ in overlays))
    methods = tuple(dict.fromkeys(method for _, method in overlays))
    ranges = [_plot_range([overlays[key] for key in overlays if key[0] == name])
              for name in sequences]
    width = float(np.clip(10.0 / len(methods), 3.4, 6.0))
    heights = [width * each.aspect + DECORATION_IN for each in ranges]
    figure = Figure((width * len(methods) + 0.5,
                     LEGEND_IN + sum(heights) + HEADING_IN * len(heights)), layout='constrained')
    grid = figure.add_gridspec(1 + 2 * len(sequences), len(methods), height_ratios=[
        LEGEND_IN, *(part for height in heights for part in (HEADING_IN, height))])
    for row, (sequence, plot_range) in enumerate(zip(sequences, ranges, strict=True)):
        _write(figure.add_subplot(grid[2 * row + 1, :]), sequence, weight='bold', size='large')
        contents = {method: overlays.get((sequence, method), 'no result') for method in methods}
        _draw_row([figure.add_subplot(grid[2 * row + 2, column])
                   for column in range(len(methods))], contents, plot_range)
    _draw_legend(figure.add_subplot(grid[0, :]), figure.axes)
    return figure


def errors_figure(runs: Sequence[PlottedRun]) -> Figure:
    """Return a figure of error over time: axes for each sequence, a line for each method.

    Distance to the truth [m] after alignment by Sim(3); a method without ATE has no line.
    Expects one run at least.
    """
    by_sequence: dict[str, list[PlottedRun]] = {}
    for run in runs:
        by_sequence.setdefault(run.sequence, []).append(run)
    methods = dict.fromkeys(run.method for run in runs)
    colours = {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(methods)}
    columns = 1 if len(by_sequence) == 1 else 2
    rows = -(-len(by_sequence) // columns)
    figure = Figure((7.5 * columns, 2.7 * rows + 0.3), layout='constrained')
    for number, (sequence, of_sequence) in enumerate(by_sequence.items(), 1):
        axes = figure.add_subplot(rows, columns, number)
        axes.set_title(sequence, loc='left', weight='bold')
        _draw_errors(axes, of_sequence, colours)
    return figure


def align_overlay(estimate: Trajectory, truth: Trajectory, keyframes_ns: np.ndarray) -> Overlay:
    """Return an estimate aligned with the truth; raises KfvoError where there is no ATE."""
    error = metrics.absolute_trajectory_error(estimate, truth)
    positions = error.alignment.transform_points(estimate.positions)
    percent = 100.0 * error.rmse / error.path_length
    return Overlay(metrics.associate_trajectories(estimate, truth)[1].positions, positions,
                   positions[np.isin(estimate.stamps_ns, keyframes_ns)],
                   f'ATE {format_metres(error.rmse)}, {percent:.2f} % of '
                   f'{error.path_length:.2f} m')


def draw_overlay(axes: Any, overlay: Overlay, plane: tuple[int, int]) -> None:
    """Draw an estimate on the truth in the plane of two axes of the world, across and up."""
    truth, estimate, keyframes = (positions[:, plane].T for positions in (
        overlay.truth, overlay.estimate, overlay.keyframes))
    axes.plot(*truth, color=TRUTH, linewidth=3.0, alpha=0.5, label='truth')
    axes.plot(*estimate, color=ESTIMATE, linewidth=1.0, label='estimate')
    axes.plot(*keyframes, '.', color=ESTIMATE, markersize=4.0, label='keyframes')
    axes.plot(*estimate[:, :1], 'o', color='black', markersize=5.0, label='start')
    axes.set(xlabel=f'{"xyz"[plane[0]]} [m]', ylabel=f'{"xyz"[plane[1]]} [m]')
    axes.set_aspect('equal', adjustable='datalim')
    style_axes(axes)


def style_axes(axes: Any) -> None:
    """Give axes the grid and the frame of all plots."""
    axes.grid(alpha=0.25, which='both')
    axes.spines[['top', 'right']].set_visible(False)


def format_metres(error: float) -> str:
    """Return an error [m] with four decimals below one metre and two above."""
    return f'{error:.4f} m' if error < 1.0 else f'{error:.2f} m'


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; an earlier file stays until this one is complete."""
    with atomic_write(path) as draft:
        figure.savefig(draft, format='png', dpi=150)


def _overlay_or_reason(run: PlottedRun) -> Overlay | str:
    """Return the overlay of a run, or the reason why it has none."""
    try:
        return align_overlay(run.estimate, run.truth, run.keyframes_ns)
    except KfvoError as problem:
        return f'no ATE: {problem}'


def _plot_range(contents: Sequence[Overlay | str]) -> PlotRange:
    """Return the range that shows truth and estimates of a sequence in full."""
    overlays = [each for each in contents if isinstance(each, Overlay)]
    if not overlays:
        return PlotRange((0, 1), np.zeros(2), np.array([1.0, MIN_ASPECT]))
    spread = np.var(np.concatenate([each.truth for each in overlays]), axis=0)
    across, up = sorted(np.argsort(spread, kind='stable')[1:].tolist())
    shown = np.concatenate([positions[:, (across, up)] for each in overlays
                            for positions in (each.truth, each.estimate)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    width, height = 1.1 * (high - low)
    width = max(width, height / MAX_ASPECT)
    half = 0.5 * np.array([width, max(height, MIN_ASPECT * width)])
    centre = 0.5 * (low + high)
    return PlotRange((across, up), centre - half, centre + half)


def _draw_row(row: Sequence[Any], contents: dict[str, Overlay | str],
              plot_range: PlotRange) -> None:
    """Draw the runs of one sequence, or their reasons; the first axes carry the numbers."""
    drawn = []
    for axes, (method, content) in zip(row, contents.items(), strict=True):
        if isinstance(content, str):
            axes.set_title(method, size='medium')
            _write(axes, textwrap.fill(content, 45), 'center', color='grey', size='small')
            continue
        draw_overlay(axes, content, plot_range.plane)
        # Fixed limits would conflict with the equal aspect.
        axes.update_datalim([plot_range.low, plot_range.high])
        axes.margins(0.0)
        axes.locator_params(axis='x', nbins=5)  # room for numbers of many digits
        axes.set_title(f'{method}\n{content.caption}', size='medium')
        drawn.append(axes)
    for axes in drawn[1:]:
        axes.set_ylabel('')
        axes.tick_params(labelleft=False)


def _draw_errors(axes: Any, runs: Sequence[PlottedRun], colours: dict[str, str]) -> None:
    """Draw the errors of all methods on one sequence."""
    style_axes(axes)
    rmse, reasons = [], []
    for run in runs:
        try:
            error = metrics.absolute_trajectory_error(run.estimate, run.truth)
        except KfvoError as problem:
            reasons.append(textwrap.fill(f'{run.method}: no ATE: {problem}', 90))
            continue
        seconds = (error.stamps_ns - run.estimate.stamps_ns.min()) / NANOSECONDS
        axes.plot(seconds, error.errors, color=colours[run.method], linewidth=1.2,
                  label=f'{run.method}, ATE {format_metres(error.rmse)}')
        rmse.append(error.rmse)
    if not rmse:
        _write(axes, '\n'.join(reasons), color='grey', size='small')
        return
    axes.set(xlabel='time [s]', ylabel='position error [m]')
    if max(rmse) > LOG_SCALE_RATIO * min(rmse) > 0.0:
        axes.set(yscale='log')
        axes.set_ylim(bottom=0.1 * min(rmse))
        axes.yaxis.set_major_formatter('{x:g}')
    else:
        axes.set_ylim(bottom=0.0)
    axes.legend(loc='upper left', bbox_to_anchor=(1.01, 1.0), frameon=False)


def _write(axes: Any, text: str, align: Literal['left', 'center'] = 'left',
           **style: Any) -> None:
    """Write text in place of axes."""
    axes.axis('off')
    axes.text({'left': 0.0, 'center': 0.5}[align], 0.5, text, horizontalalignment=align,
              verticalalignment='center', transform=axes.transAxes, **style)


def _draw_legend(axes: Any, drawn: Sequence[Any]) -> None:
    """Draw the legend that all axes share."""
    axes.axis('off')
    entries: dict[str, Any] = {}
    for each in drawn:
        handles, labels = each.get_legend_handles_labels()
        entries |= zip(labels, handles, strict=True)
    if entries:
        axes.legend(entries.values(), entries.keys(), loc='center', ncols=len(entries),
                    frameon=False)
