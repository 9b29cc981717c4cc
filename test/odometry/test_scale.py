# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scale of a window relative to the trajectory, by each rule."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Estimate, Points, WindowPrior
from kfvo_ros.odometry.scale import (
    MIN_AGREEMENT,
    MIN_SHARED_POINTS,
    SCALE_RULES,
    STANDSTILL,
    ScaleAligner,
    compare_depths,
    compare_translations,
)

RNG = np.random.default_rng(0)
POSITIONS = RNG.uniform(1.0, 5.0, (40, 3))
POSES = geometry.make_transform(geometry.exp_so3(0.1 * RNG.normal(size=(8, 3))),
                                RNG.normal(size=(8, 3)))
POSES[0] = np.eye(4)


def points(scale: float = 1.0, count: int = 40, first_id: int = 0) -> Points:
    return Points(np.arange(first_id, first_id + count), scale * POSITIONS[:count],
                  np.ones(count))


def poses(scale: float) -> np.ndarray:
    result = POSES.copy()
    result[:, :3, 3] *= scale
    return result


def estimate(unit: float, with_points: bool = True, translations: float | None = None
             ) -> Estimate:
    """Return a window whose unit is `unit` trajectory units."""
    return Estimate(poses(1.0 / unit if translations is None else translations),
                    lambda: np.zeros((8, 6, 6)), points(1.0 / unit) if with_points else None,
                    np.zeros(0, dtype=np.float32))


def prior(with_points: bool = True) -> WindowPrior:
    return WindowPrior(poses(1.0)[:7], np.eye(4), points() if with_points else None)


def test_names_of_the_rules():
    assert SCALE_RULES == ('none', 'translation', 'depth')


@pytest.mark.parametrize(('rule', 'expected'), [('none', 1.0), ('translation', 2.5),
                                                ('depth', 2.5)])
def test_unit_of_a_window_is_estimated(rule, expected):
    assert ScaleAligner(rule).align(estimate(2.5), prior()) == pytest.approx(expected)


def test_each_rule_uses_its_own_measurement():
    contradictory = estimate(2.0, translations=1.0 / 3.0)
    assert ScaleAligner('depth').align(contradictory, prior()) == pytest.approx(2.0)
    assert ScaleAligner('translation').align(contradictory, prior()) == pytest.approx(3.0)


def test_depth_falls_back_to_translation_without_points():
    contradictory = estimate(2.0, with_points=False, translations=1.0 / 3.0)
    assert ScaleAligner('depth').align(contradictory, prior(False)) == pytest.approx(3.0)
    others = Estimate(contradictory.T_anchor_frame, contradictory.make_covariance,
                      points(0.5, first_id=1000), contradictory.signals)
    assert ScaleAligner('depth').align(others, prior()) == pytest.approx(3.0)


def test_standstill_keeps_the_last_scale():
    aligner = ScaleAligner('translation')
    assert aligner.align(estimate(2.5), prior()) == pytest.approx(2.5)
    still = estimate(7.0)
    still.T_anchor_frame[1:7, :3, 3] *= 1e-5  # only the newest frame moves
    assert aligner.align(still, prior()) == pytest.approx(2.5)
    assert aligner.align(estimate(4.0), prior()) == pytest.approx(4.0)


def test_a_window_without_motion_keeps_the_last_scale():
    aligner = ScaleAligner('translation')
    aligner.align(estimate(2.5), prior())
    assert aligner.align(estimate(1.0, translations=0.0), prior()) == pytest.approx(2.5)


def align_windows(positions: np.ndarray, noise: float, rng: np.random.Generator) -> list[float]:
    """Return the scale of each window along positions (N, 3) when every frame is a keyframe.

    Each window has its own noise, as of a backbone without points.
    """
    aligner, known, scales = ScaleAligner('translation'), np.zeros((1, 3)), []
    for newest in range(1, len(positions)):
        window = positions[max(newest - 7, 0):newest + 1]
        known = known[-len(window) + 1:]
        seen = np.tile(np.eye(4), (len(window), 1, 1))
        seen[1:, :3, 3] = window[1:] - window[0] + noise * rng.normal(size=(len(window) - 1, 3))
        before = np.tile(np.eye(4), (len(known), 1, 1))
        before[:, :3, 3] = known - known[0]
        scales.append(aligner.align(
            Estimate(seen, lambda: np.zeros((8, 6, 6)), None, np.zeros(0, dtype=np.float32)),
            WindowPrior(before, np.eye(4), None)))
        known = known[0] + scales[-1] * seen[:, :3, 3]
    return scales


@pytest.mark.parametrize('noise', [1e-6, 1e-3, 3e-3])
def test_the_scale_does_not_drift_at_standstill(noise):
    moves = np.concatenate([np.ones(20), np.zeros(100), np.ones(20)])
    positions = np.cumsum(0.05 * moves[:, None] * [1.0, 0.2, 0.3], axis=0)
    for seed in range(10):
        scales = align_windows(positions, noise, np.random.default_rng(seed))
        assert 0.6 < scales[-1] / scales[17] < 1.6


def test_a_repeated_image_keeps_the_last_scale():
    aligner = ScaleAligner('translation')
    assert aligner.align(estimate(2.5), prior()) == pytest.approx(2.5)
    known = WindowPrior(np.tile(np.eye(4), (7, 1, 1)), np.eye(4), None)  # all at the anchor
    assert aligner.align(estimate(7.0, with_points=False), known) == pytest.approx(2.5)


def test_first_window_starts_at_median_depth_one():
    for rule in ('translation', 'depth'):
        first = estimate(1.0)
        scale = ScaleAligner(rule).align(first, None)
        assert scale * np.median(first.points.depths) == pytest.approx(1.0)
    assert ScaleAligner('translation').align(estimate(1.0, with_points=False), None) == 1.0
    assert ScaleAligner('none').align(estimate(3.0), None) == 1.0


def test_a_restart_continues_with_the_last_median_depth():
    aligner = ScaleAligner('depth')
    aligner.align(estimate(2.0), prior())
    depth = 2.0 * np.median(estimate(2.0).points.depths)
    restarted = estimate(9.0)
    scale = aligner.align(restarted, None)
    assert scale * np.median(restarted.points.depths) == pytest.approx(depth)
    prior_without_points = WindowPrior(poses(1.0)[:7], np.eye(4), None, memory='something')
    restarted = estimate(0.3)
    scale = aligner.align(restarted, prior_without_points)
    assert scale * np.median(restarted.points.depths) == pytest.approx(depth)


def test_translation_rule_is_the_least_squares_ratio():
    known, new = poses(1.0)[:7], poses(0.4)
    new[3, :3, 3] *= 1.3
    a = np.linalg.norm(known[1:, :3, 3], axis=1)
    b = np.linalg.norm(new[1:7, :3, 3], axis=1)
    candidates = np.linspace(1.0, 4.0, 30001)
    best = candidates[((a - candidates[:, None] * b) ** 2).sum(axis=1).argmin()]
    assert compare_translations(known, new) == pytest.approx(best, abs=2e-4)


def test_depth_rule_is_a_weighted_median():
    known, new = points(), points(0.5)
    wrong = new.positions.copy()
    wrong[:15] *= 10.0  # fewer than half: no influence
    assert compare_depths(known, Points(new.ids, wrong, new.information)) == pytest.approx(2.0)
    wrong = new.positions.copy()
    wrong[:30] *= 10.0  # the majority, but of low information
    information = np.where(np.arange(40) < 30, 0.01, 1.0)
    assert compare_depths(known, Points(new.ids, wrong, information)) == pytest.approx(2.0)
    assert compare_depths(Points(known.ids, known.positions, information),
                          Points(new.ids, wrong, new.information)) == pytest.approx(2.0)
    assert compare_depths(known, Points(new.ids, wrong, new.information)) == pytest.approx(0.2)


def test_points_are_matched_by_id():
    known, new = points(), points(0.5)
    some = np.arange(5, 40, 2)
    assert compare_depths(known, Points(new.ids[some], new.positions[some],
                                        new.information[some])) == pytest.approx(2.0)


def test_too_few_points_or_no_information_give_none():
    few = points(0.5, MIN_SHARED_POINTS - 1)
    assert compare_depths(points(), few) is None
    assert compare_depths(points(), points(0.5, MIN_SHARED_POINTS)) == pytest.approx(2.0)
    without_information = points(0.5)
    assert compare_depths(points(), Points(without_information.ids, without_information.positions,
                                           np.zeros(40))) is None
    assert compare_depths(None, few) is None


@pytest.mark.parametrize(('factor', 'moves'), [(0.99, False), (1.01, True)])
def test_standstill_is_a_share_of_the_extent(factor, moves):
    new = np.tile(np.eye(4), (3, 1, 1))
    new[2, 0, 3] = 4.0  # the newest frame: the extent of the window
    new[1, 0, 3] = factor * STANDSTILL * 4.0
    known = new[:2].copy()
    known[1, 0, 3] = 2.0 * new[1, 0, 3]
    assert compare_translations(known, new) == (pytest.approx(2.0) if moves else None)


@pytest.mark.parametrize(('offset', 'agree'), [(0.01, True), (-0.01, False)])
def test_known_and_new_positions_must_agree(offset, agree):
    angle = np.arccos(MIN_AGREEMENT + offset)
    known, new = (np.tile(np.eye(4), (count, 1, 1)) for count in (2, 3))
    known[1, :3, 3] = [3.0, 0.0, 0.0]
    new[1, :3, 3] = [np.cos(angle), np.sin(angle), 0.0]
    new[2, :3, 3] = 2.0 * new[1, :3, 3]
    assert compare_translations(known, new) == (pytest.approx(3.0) if agree else None)
