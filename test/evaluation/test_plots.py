# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plots of a benchmark: content, layout and readability."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from trajectories import perturbed, random_walk, trajectory

matplotlib = pytest.importorskip('matplotlib',
                                 reason="matplotlib is not installed: pip install '.[demo]'")

from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.colors import to_hex  # noqa: E402

from kfvo_ros.evaluation import metrics  # noqa: E402
from kfvo_ros.evaluation.plots import (  # noqa: E402
    ESTIMATE,
    TRUTH,
    PlottedRun,
    errors_figure,
    plot_trajectory,
    save_figure,
    trajectories_figure,
)
from kfvo_ros.trajectory import Trajectory  # noqa: E402

METHODS = ('every', 'optical_flow', 'survival', 'learned', 'constant_position', 'straight_line')


def make_runs(sequences: int, methods: int) -> list[PlottedRun]:
    """Return runs of different error on paths of different size and shape."""
    runs = []
    for number in range(sequences):
        truth = random_walk(number)
        stretched = truth.poses.copy()
        stretched[:, :3, 3] *= [[8.0, 1.0, 1.0], [1.0, 0.1, 9.0], [1e-4, 2e-4, 1e-4]][number % 3]
        stretched[:, :3, 3] += [0.0, 0.0, 0.8645][number % 3]
        truth = Trajectory(truth.stamps_ns, stretched)
        noise = 0.005 * np.ptp(truth.positions)
        runs += [PlottedRun(f'sequence_{number:02d}_with_a_name', method,
                       perturbed(truth, index, trans=noise * (1.0 + index)), truth,
                       truth.stamps_ns[::1 + 5 * index])
                 for index, method in enumerate(METHODS[:methods])]
    return runs


def lines_by_label(axes: Any) -> dict[str, np.ndarray]:
    """Return the lines (N, 2) in axes by label."""
    return {line.get_label(): line.get_xydata() for line in axes.lines}


def axes_with_lines(figure: Any) -> list[Any]:
    """Return the axes of a figure that hold lines."""
    return [axes for axes in figure.axes if axes.lines]


def texts_of(axes: Any) -> list[Any]:
    """Return the visible texts in and around axes."""
    texts = [*axes.texts, axes.title, axes._left_title]
    if axes.get_legend():
        texts += axes.get_legend().get_texts()
    if axes.axison:
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            texts += [axis.label, *(
                label for place, label in zip(axis.get_ticklocs(), axis.get_ticklabels())
                if min(limits) <= place <= max(limits))]
    return [text for text in texts if text.get_visible() and text.get_text()]


def assert_readable(figure: Any) -> None:
    """Check that no text overlaps another or leaves the figure."""
    FigureCanvasAgg(figure).draw()
    boxes = [(text.get_text(), text.get_window_extent())
             for axes in figure.axes for text in texts_of(axes)]
    assert boxes
    for text, box in boxes:
        assert box.x0 >= 0 and box.y0 >= 0, text
        assert box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1, text
    # Horizontally the gap is half a digit or more; lines of text may touch.
    overlapping = [(one, other) for (one, a), (other, b) in combinations(boxes, 2)
                if min(a.x1, b.x1) - max(a.x0, b.x0) > -3.0
                and min(a.y1, b.y1) - max(a.y0, b.y0) > 1.0]
    assert not overlapping


@pytest.mark.parametrize('sequences, methods', [(1, 1), (1, 6), (2, 3), (3, 2), (11, 6)])
def test_figures_are_readable(sequences, methods):
    runs = make_runs(sequences, methods)
    assert_readable(trajectories_figure(runs))
    assert_readable(errors_figure(runs))


def test_numbers_of_many_digits_have_room():
    angles = np.linspace(0.0, 6.0, 60)
    truth = trajectory(np.column_stack([0.8641 + 0.0011 * np.sin(angles), 0.0 * angles,
                                        0.9255 + 0.0014 * np.cos(2.0 * angles)]))
    assert_readable(trajectories_figure(
        [PlottedRun('a', method, truth, truth, truth.stamps_ns) for method in METHODS]))


def test_rows_are_sequences_and_columns_are_methods():
    runs = make_runs(3, 4)
    figure = trajectories_figure(runs)
    FigureCanvasAgg(figure).draw()
    drawn = axes_with_lines(figure)
    corners = np.array([[axes.bbox.x0, axes.bbox.y0] for axes in drawn]).reshape(3, 4, 2)
    assert (np.ptp(corners[..., 0], axis=0) < 1.0).all() and (np.diff(corners[..., 0]) > 0).all()
    assert (np.ptp(corners[..., 1], axis=1) < 1.0).all()
    assert (np.diff(corners[..., 1], axis=0) < 0).all()
    assert [bool(axes.get_ylabel()) for axes in drawn] == 3 * [True, False, False, False]
    for axes, run in zip(drawn, runs, strict=True):
        error = metrics.absolute_trajectory_error(run.estimate, run.truth)
        method, ate = axes.get_title().split('\n')
        assert method == run.method
        assert ate.split(' m,')[0] == (f'ATE {error.rmse:.4f}' if error.rmse < 1.0 else
                                       f'ATE {error.rmse:.2f}')
        assert f'{100.0 * error.rmse / error.path_length:.2f} % of' in ate
    headings = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert headings == list(dict.fromkeys(run.sequence for run in runs))


def test_truth_estimate_and_keyframes_are_drawn_at_their_positions():
    run = make_runs(1, 2)[1]
    [axes] = axes_with_lines(trajectories_figure([run]))
    lines = lines_by_label(axes)
    error = metrics.absolute_trajectory_error(run.estimate, run.truth)
    aligned = error.alignment.transform_points(run.estimate.positions)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ('x [m]', 'y [m]')
    np.testing.assert_allclose(lines['truth'], run.truth.positions[:, :2])
    np.testing.assert_allclose(lines['estimate'], aligned[:, :2])
    np.testing.assert_allclose(lines['keyframes'], aligned[::6, :2])
    np.testing.assert_allclose(lines['start'], aligned[:1, :2])
    colours = {line.get_label(): to_hex(line.get_color()) for line in axes.lines}
    assert colours['truth'] == TRUTH == '#d62728'
    assert colours['estimate'] == colours['keyframes'] == ESTIMATE


@pytest.mark.parametrize('spread, plane', [
    ((3.0, 2.0, 1.0), 'xy'), ((3.0, 0.1, 9.0), 'xz'), ((0.0, 1.0, 5.0), 'yz'),
    ((0.0, 0.0, 5.0), 'yz')])
def test_the_plane_is_that_of_the_largest_spread_of_the_truth(spread, plane):
    angles = np.linspace(0.0, 5.0, 50)
    truth = trajectory(np.column_stack([np.cos(angles), np.sin(angles), np.sin(2.0 * angles)])
                       * spread)
    [axes] = axes_with_lines(trajectories_figure(
        [PlottedRun('a', 'b', truth, truth, truth.stamps_ns)]))
    assert (axes.get_xlabel(), axes.get_ylabel()) == (f'{plane[0]} [m]', f'{plane[1]} [m]')
    np.testing.assert_allclose(lines_by_label(axes)['truth'],
                               truth.positions[:, ['xyz'.index(each) for each in plane]])


def test_axes_of_a_sequence_share_a_range_that_holds_all_lines():
    runs = make_runs(2, 3)
    figure = trajectories_figure(runs)
    FigureCanvasAgg(figure).draw()
    for row in np.array(axes_with_lines(figure)).reshape(2, 3):
        limits = np.array([[axes.get_xlim(), axes.get_ylim()] for axes in row])
        np.testing.assert_allclose(limits, limits[[0, 0, 0]], rtol=1e-3, atol=1e-2)
        for axes in row:
            points = np.concatenate(list(lines_by_label(axes).values()))
            shown = np.array([axes.get_xlim(), axes.get_ylim()])
            assert (shown[:, 0] < points.min(axis=0)).all()
            assert (points.max(axis=0) < shown[:, 1]).all()
            # A metre across is as long as a metre up, but for matplotlib's tolerance of 0.5 %.
            assert axes.bbox.width / np.ptp(shown[0]) == pytest.approx(
                axes.bbox.height / np.ptp(shown[1]), rel=0.005)


def test_axes_without_result_or_ate_state_the_reason():
    runs = make_runs(2, 3)
    still = replace(runs[1], truth=trajectory(np.ones((150, 3))))
    still = replace(still, truth=Trajectory(still.estimate.stamps_ns, still.truth.poses))
    figure = trajectories_figure([runs[0], still, *runs[2:5]])
    assert_readable(figure)
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert sum('truth never moves' in ' '.join(text.split()) for text in texts) == 1
    assert texts.count('no result') == 1
    assert len(axes_with_lines(figure)) == 4
    assert_readable(trajectories_figure([still]))
    errors = errors_figure([still, *runs[3:]])
    FigureCanvasAgg(errors).draw()
    assert 'truth never moves' in ' '.join(errors.axes[0].texts[0].get_text().split())


def test_error_lines_are_the_errors_of_the_ate_over_time():
    runs = make_runs(2, 3)
    figure = errors_figure(runs)
    assert len(figure.axes) == 2
    for axes, of_sequence in zip(figure.axes, (runs[:3], runs[3:]), strict=True):
        assert axes._left_title.get_text() == of_sequence[0].sequence
        assert (axes.get_xlabel(), axes.get_ylabel()) == ('time [s]', 'position error [m]')
        for line, run in zip(axes.lines, of_sequence, strict=True):
            error = metrics.absolute_trajectory_error(run.estimate, run.truth)
            seconds = (error.stamps_ns - error.stamps_ns[0]) / 1e9
            np.testing.assert_allclose(line.get_xydata(), np.c_[seconds, error.errors])
            assert line.get_label().startswith(f'{run.method}, ATE ')
    colours = [[line.get_color() for line in axes.lines] for axes in figure.axes]
    assert colours[0] == colours[1] and len(set(colours[0])) == 3


@pytest.mark.parametrize('factor, scale', [(3.0, 'linear'), (300.0, 'log')])
def test_errors_of_different_magnitude_have_a_logarithmic_axis(factor, scale):
    truth = random_walk(0)
    runs = [PlottedRun('a', name, perturbed(truth, 0, trans=noise), truth, truth.stamps_ns)
            for name, noise in (('good', 0.01), ('bad', 0.01 * factor))]
    [axes] = errors_figure(runs).axes
    assert axes.get_yscale() == scale
    assert axes.get_ylim()[1] > max(line.get_ydata().max() for line in axes.lines)


def test_figures_are_written_atomically_as_png(tmp_path: Path):
    runs = make_runs(2, 2)
    for name, make_figure in (('trajectories.png', trajectories_figure),
                              ('errors.png', errors_figure)):
        save_figure(make_figure(runs), tmp_path / name)
        image = cv2.imread(str(tmp_path / name))
        assert image.shape[0] > 300 and image.shape[1] > 1000
        blue, green, red = (image[..., channel].astype(int) for channel in range(3))
        if make_figure is trajectories_figure:
            assert (red - np.maximum(blue, green) > 60).sum() > 500
            assert (blue - np.maximum(red, green) > 60).sum() > 500
    assert {path.name for path in tmp_path.iterdir()} == {'trajectories.png', 'errors.png'}
    with pytest.raises(FileNotFoundError):
        save_figure(errors_figure(runs), tmp_path / 'missing' / 'errors.png')


def test_plot_of_one_trajectory(tmp_path: Path):
    run = make_runs(1, 1)[0]
    plot_trajectory(tmp_path / 'one.png', run.estimate, run.truth, run.keyframes_ns, 'one')
    image = cv2.imread(str(tmp_path / 'one.png'))
    assert image.shape == (780, 1500, 3)
    for colour in (ESTIMATE, TRUTH):
        rgb = [int(colour[at:at + 2], 16) for at in (1, 3, 5)]
        wanted = rgb if colour == ESTIMATE else [255 - (255 - each) // 2 for each in rgb]
        distance = np.abs(image[..., ::-1].astype(int) - wanted).max(axis=2)
        assert (distance < 12).sum() > 100
