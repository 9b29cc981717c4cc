# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of trajectories, and how all pictures look."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from kfvo_ros.evaluation import metrics
from kfvo_ros.trajectory import Trajectory
from kfvo_ros.utils.files import atomic_write

TRUTH, ESTIMATE = '#d62728', '#1f4e9c'
COLOURS = ('#000000', '#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9',
           '#8c564b')
"""Of lines in one picture: Okabe and Ito's, which nearly all eyes tell apart."""


@dataclass(frozen=True)
class Overlay:
    """An estimate on the truth, aligned by Sim(3): positions (..., 3) in the truth's world [m].

    ``truth`` (M, 3) where the estimate matches it, ``estimate`` (N, 3) and, among it,
    ``keyframes`` (K, 3); ``caption`` tells the ATE.
    """

    truth: np.ndarray
    estimate: np.ndarray
    keyframes: np.ndarray
    caption: str


def lay_over(estimate: Trajectory, truth: Trajectory, keyframes_ns: np.ndarray) -> Overlay:
    """Align an estimate with the truth; raises KfvoError where there is no ATE."""
    error = metrics.absolute_trajectory_error(estimate, truth)
    positions = error.alignment.transform_points(estimate.positions)
    share = 100.0 * error.rmse / error.path_length
    return Overlay(metrics.match(estimate, truth)[1].positions, positions,
                   positions[np.isin(estimate.stamps_ns, keyframes_ns)],
                   f'ATE {in_metres(error.rmse)}, {share:.2f} % of {error.path_length:.2f} m')


def in_metres(error: float) -> str:
    """Return an error with the decimals that mean something, in a room or on a road."""
    return f'{error:.4f} m' if error < 1.0 else f'{error:.2f} m'


def plot_trajectory(path: Path, estimate: Trajectory, truth: Trajectory,
                    keyframes_ns: np.ndarray, title: str) -> None:
    """Draw an estimate on the truth (z up, metres), from above and from the side, as PNG."""
    overlay = lay_over(estimate, truth, keyframes_ns)
    figure = Figure(figsize=(10.0, 5.2), layout='constrained')
    figure.suptitle(f'{title}: {overlay.caption}')
    for axes, plane, name in zip(figure.subplots(1, 2), ((0, 1), (0, 2)),
                                 ('from above', 'from the side'), strict=True):
        draw_overlay(axes, overlay, plane)
        axes.set_title(name)
    axes.legend(frameon=False)
    save(figure, path)


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
    tidy(axes)


def tidy(axes: Any) -> None:
    """Give axes the grid and the frame that all pictures have."""
    axes.grid(alpha=0.25, which='both')
    axes.spines[['top', 'right']].set_visible(False)


def save(figure: Figure, path: Path) -> None:
    """Write a picture as PNG; an earlier one stays until this one is complete."""
    with atomic_write(path) as draft:
        figure.savefig(draft, format='png', dpi=150)
