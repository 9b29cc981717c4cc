# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from kfvo_ros import metrics
from kfvo_ros.trajectory import Trajectory, associate

TRUTH, ESTIMATE = '#d62728', '#1f4e9c'


def plot_trajectory(path: Path, estimate: Trajectory, truth: Trajectory,
                    keyframes_ns: np.ndarray, title: str) -> None:
    """Draw an estimate on the truth (z up, metres), from above and from the side, as PNG.

    The estimate is aligned by Sim(3); keyframes are dots.
    """
    error = metrics.absolute_trajectory_error(estimate, truth)
    positions = error.alignment.transform_points(estimate.positions)
    dots = positions[np.isin(estimate.stamps_ns, keyframes_ns)]
    matched, _ = associate(truth.stamps_ns, estimate.stamps_ns)
    true = truth.positions[matched]
    figure = Figure(figsize=(10.0, 5.2), dpi=150, layout='constrained')
    figure.suptitle(f'{title}: ATE {error.rmse:.4f} m, '
                    f'{100.0 * error.rmse / error.path_length:.2f} % of {error.path_length:.2f} m')
    for axes, (across, up), name in zip(figure.subplots(1, 2), ((0, 1), (0, 2)),
                                        ('from above', 'from the side'), strict=True):
        _draw(axes, true[:, [across, up]], positions[:, [across, up]], dots[:, [across, up]])
        axes.set(title=name, xlabel='xyz'[across] + ' [m]', ylabel='xyz'[up] + ' [m]')
    axes.legend(frameon=False)
    figure.savefig(path)


def _draw(axes: Any, truth: np.ndarray, estimate: np.ndarray, keyframes: np.ndarray) -> None:
    axes.plot(*truth.T, color=TRUTH, linewidth=3.0, alpha=0.5, label='truth')
    axes.plot(*estimate.T, color=ESTIMATE, linewidth=1.0, label='kfvo_node')
    axes.plot(*keyframes.T, '.', color=ESTIMATE, markersize=5.0, label='keyframes')
    axes.plot(*estimate[:1].T, 'o', color='black', markersize=5.0, label='start')
    axes.set_aspect('equal', adjustable='datalim')
    axes.grid(alpha=0.25)
    axes.spines[['top', 'right']].set_visible(False)
