# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of a benchmark: what is drawn, where, and that it can be read."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from trajectories import disturbed, trajectory, wandering

matplotlib = pytest.importorskip('matplotlib',
                                 reason="matplotlib is not installed: pip install '.[demo]'")

from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.colors import to_hex  # noqa: E402

from kfvo_ros.evaluation import metrics  # noqa: E402
from kfvo_ros.evaluation.figures import (  # noqa: E402
    Panel,
    draw_errors,
    draw_trajectories,
    figure_of_errors,
    figure_of_trajectories,
)
from kfvo_ros.evaluation.plots import ESTIMATE, TRUTH, plot_trajectory  # noqa: E402
from kfvo_ros.trajectory import Trajectory  # noqa: E402

METHODS = ('every', 'optical_flow', 'survival', 'learned', 'constant_position', 'straight_line')


def panels_of(sequences: int, methods: int) -> list[Panel]:
    """Return runs of different error on paths of different size and shape."""
    runs = []
    for number in range(sequences):
        truth = wandering(number)
        stretched = truth.poses.copy()
        stretched[:, :3, 3] *= [[8.0, 1.0, 1.0], [1.0, 0.1, 9.0], [1e-4, 2e-4, 1e-4]][number % 3]
        stretched[:, :3, 3] += [0.0, 0.0, 0.8645][number % 3]
        truth = Trajectory(truth.stamps_ns, stretched)
        noise = 0.005 * np.ptp(truth.positions)
        runs += [Panel(f'sequence_{number:02d}_with_a_name', method,
                       disturbed(truth, index, trans=noise * (1.0 + index)), truth,
                       truth.stamps_ns[::1 + 5 * index])
                 for index, method in enumerate(METHODS[:methods])]
    return runs


def drawn(axes: Any) -> dict[str, np.ndarray]:
    """Return the lines (N, 2) in axes by name."""
    return {line.get_label(): line.get_xydata() for line in axes.lines}


def with_lines(figure: Any) -> list[Any]:
    """Return the axes in which something is drawn."""
    return [axes for axes in figure.axes if axes.lines]


def texts_of(axes: Any) -> list[Any]:
    """Return what can be read in or around axes."""
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
    """Check that no text lies on another, nor beyond the picture."""
    FigureCanvasAgg(figure).draw()
    boxes = [(text.get_text(), text.get_window_extent())
             for axes in figure.axes for text in texts_of(axes)]
    assert boxes
    for text, box in boxes:
        assert box.x0 >= 0 and box.y0 >= 0, text
        assert box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1, text
    # Across, half the width of a digit lies between; lines of text may touch.
    clashing = [(one, other) for (one, a), (other, b) in combinations(boxes, 2)
                if min(a.x1, b.x1) - max(a.x0, b.x0) > -3.0
                and min(a.y1, b.y1) - max(a.y0, b.y0) > 1.0]
    assert not clashing


@pytest.mark.parametrize('sequences, methods', [(1, 1), (1, 6), (2, 3), (3, 2), (11, 6)])
def test_pictures_can_be_read(sequences, methods):
    panels = panels_of(sequences, methods)
    assert_readable(figure_of_trajectories(panels))
    assert_readable(figure_of_errors(panels))


def test_numbers_of_many_digits_have_room():
    angles = np.linspace(0.0, 6.0, 60)
    truth = trajectory(np.column_stack([0.8641 + 0.0011 * np.sin(angles), 0.0 * angles,
                                        0.9255 + 0.0014 * np.cos(2.0 * angles)]))
    assert_readable(figure_of_trajectories(
        [Panel('a', method, truth, truth, truth.stamps_ns) for method in METHODS]))


def test_a_row_for_each_sequence_and_a_column_for_each_method():
    panels = panels_of(3, 4)
    figure = figure_of_trajectories(panels)
    FigureCanvasAgg(figure).draw()
    runs = with_lines(figure)
    places = np.array([[axes.bbox.x0, axes.bbox.y0] for axes in runs]).reshape(3, 4, 2)
    assert (np.ptp(places[..., 0], axis=0) < 1.0).all() and (np.diff(places[..., 0]) > 0).all()
    assert (np.ptp(places[..., 1], axis=1) < 1.0).all()
    assert (np.diff(places[..., 1], axis=0) < 0).all()
    assert [bool(axes.get_ylabel()) for axes in runs] == 3 * [True, False, False, False]
    for axes, panel in zip(runs, panels, strict=True):
        error = metrics.absolute_trajectory_error(panel.estimate, panel.truth)
        method, ate = axes.get_title().split('\n')
        assert method == panel.method
        assert ate.split(' m,')[0] == (f'ATE {error.rmse:.4f}' if error.rmse < 1.0 else
                                       f'ATE {error.rmse:.2f}')
        assert f'{100.0 * error.rmse / error.path_length:.2f} % of' in ate
    headings = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert headings == list(dict.fromkeys(panel.sequence for panel in panels))


def test_truth_estimate_and_keyframes_are_drawn_where_they_are():
    panel = panels_of(1, 2)[1]
    [axes] = with_lines(figure_of_trajectories([panel]))
    lines = drawn(axes)
    error = metrics.absolute_trajectory_error(panel.estimate, panel.truth)
    aligned = error.alignment.transform_points(panel.estimate.positions)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ('x [m]', 'y [m]')
    np.testing.assert_allclose(lines['truth'], panel.truth.positions[:, :2])
    np.testing.assert_allclose(lines['estimate'], aligned[:, :2])
    np.testing.assert_allclose(lines['keyframes'], aligned[::6, :2])
    np.testing.assert_allclose(lines['start'], aligned[:1, :2])
    colours = {line.get_label(): to_hex(line.get_color()) for line in axes.lines}
    assert colours['truth'] == TRUTH == '#d62728'
    assert colours['estimate'] == colours['keyframes'] == ESTIMATE


@pytest.mark.parametrize('spread, plane', [
    ((3.0, 2.0, 1.0), 'xy'), ((3.0, 0.1, 9.0), 'xz'), ((0.0, 1.0, 5.0), 'yz'),
    ((0.0, 0.0, 5.0), 'yz')])
def test_the_plane_is_the_one_in_which_the_truth_spreads_most(spread, plane):
    angles = np.linspace(0.0, 5.0, 50)
    truth = trajectory(np.column_stack([np.cos(angles), np.sin(angles), np.sin(2.0 * angles)])
                       * spread)
    [axes] = with_lines(figure_of_trajectories([Panel('a', 'b', truth, truth,
                                                      truth.stamps_ns)]))
    assert (axes.get_xlabel(), axes.get_ylabel()) == (f'{plane[0]} [m]', f'{plane[1]} [m]')
    np.testing.assert_allclose(drawn(axes)['truth'],
                               truth.positions[:, ['xyz'.index(each) for each in plane]])


def test_methods_on_a_sequence_are_seen_from_the_same_place_and_in_full():
    panels = panels_of(2, 3)
    figure = figure_of_trajectories(panels)
    FigureCanvasAgg(figure).draw()
    for row in np.array(with_lines(figure)).reshape(2, 3):
        limits = np.array([[axes.get_xlim(), axes.get_ylim()] for axes in row])
        np.testing.assert_allclose(limits, limits[[0, 0, 0]], rtol=1e-3, atol=1e-2)
        for axes in row:
            points = np.concatenate(list(drawn(axes).values()))
            view = np.array([axes.get_xlim(), axes.get_ylim()])
            assert (view[:, 0] < points.min(axis=0)).all()
            assert (points.max(axis=0) < view[:, 1]).all()
            # A metre across is as long as a metre up, but for matplotlib's tolerance of 0.5 %.
            assert axes.bbox.width / np.ptp(view[0]) == pytest.approx(
                axes.bbox.height / np.ptp(view[1]), rel=0.005)


def test_what_has_no_result_or_no_ate_says_so():
    panels = panels_of(2, 3)
    still = replace(panels[1], truth=trajectory(np.ones((150, 3))))
    still = replace(still, truth=Trajectory(still.estimate.stamps_ns, still.truth.poses))
    figure = figure_of_trajectories([panels[0], still, *panels[2:5]])
    assert_readable(figure)
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert sum('truth never moves' in ' '.join(text.split()) for text in texts) == 1
    assert texts.count('no result') == 1
    assert len(with_lines(figure)) == 4
    assert_readable(figure_of_trajectories([still]))
    errors = figure_of_errors([still, *panels[3:]])
    FigureCanvasAgg(errors).draw()
    assert 'truth never moves' in ' '.join(errors.axes[0].texts[0].get_text().split())


def test_errors_are_those_of_the_ate_over_time():
    panels = panels_of(2, 3)
    figure = figure_of_errors(panels)
    assert len(figure.axes) == 2
    for axes, runs in zip(figure.axes, (panels[:3], panels[3:]), strict=True):
        assert axes._left_title.get_text() == runs[0].sequence
        assert (axes.get_xlabel(), axes.get_ylabel()) == ('time [s]', 'position error [m]')
        for line, run in zip(axes.lines, runs, strict=True):
            error = metrics.absolute_trajectory_error(run.estimate, run.truth)
            seconds = (error.stamps_ns - error.stamps_ns[0]) / 1e9
            np.testing.assert_allclose(line.get_xydata(), np.c_[seconds, error.errors])
            assert line.get_label().startswith(f'{run.method}, ATE ')
    colours = [[line.get_color() for line in axes.lines] for axes in figure.axes]
    assert colours[0] == colours[1] and len(set(colours[0])) == 3


@pytest.mark.parametrize('worse, scale', [(3.0, 'linear'), (300.0, 'log')])
def test_errors_of_another_order_have_a_logarithmic_axis(worse, scale):
    truth = wandering(0)
    runs = [Panel('a', name, disturbed(truth, 0, trans=noise), truth, truth.stamps_ns)
            for name, noise in (('good', 0.01), ('bad', 0.01 * worse))]
    [axes] = figure_of_errors(runs).axes
    assert axes.get_yscale() == scale
    assert axes.get_ylim()[1] > max(line.get_ydata().max() for line in axes.lines)


def test_pictures_are_files_whole_or_not_at_all(tmp_path: Path):
    panels = panels_of(2, 2)
    for name, draw in (('trajectories.png', draw_trajectories), ('errors.png', draw_errors)):
        draw(tmp_path / name, panels)
        picture = cv2.imread(str(tmp_path / name))
        assert picture.shape[0] > 300 and picture.shape[1] > 1000
        blue, green, red = (picture[..., channel].astype(int) for channel in range(3))
        if draw is draw_trajectories:
            assert (red - np.maximum(blue, green) > 60).sum() > 500
            assert (blue - np.maximum(red, green) > 60).sum() > 500
    assert {path.name for path in tmp_path.iterdir()} == {'trajectories.png', 'errors.png'}
    with pytest.raises(FileNotFoundError):
        draw_errors(tmp_path / 'missing' / 'errors.png', panels)


def test_the_picture_of_one_trajectory_is_drawn_alike(tmp_path: Path):
    panel = panels_of(1, 1)[0]
    plot_trajectory(tmp_path / 'one.png', panel.estimate, panel.truth, panel.keyframes_ns, 'one')
    picture = cv2.imread(str(tmp_path / 'one.png'))
    assert picture.shape == (780, 1500, 3)
    for colour in (ESTIMATE, TRUTH):
        rgb = [int(colour[at:at + 2], 16) for at in (1, 3, 5)]
        wanted = rgb if colour == ESTIMATE else [255 - (255 - each) // 2 for each in rgb]
        distance = np.abs(picture[..., ::-1].astype(int) - wanted).max(axis=2)
        assert (distance < 12).sum() > 100
