# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe guard: decisions that it forces, and those that it leaves to the policy."""

from __future__ import annotations

import numpy as np
import pytest
from odometry_scenes import certain_tracks

from kfvo_ros.keyframes.base import DecisionInput
from kfvo_ros.keyframes.guard import NO_GUARD, KeyframeGuard
from kfvo_ros.tracking.tracker import Tracks

OBSERVATION = np.zeros(1, dtype=np.float32)


def decision(survivors: int = 80, flow: float = 10.0, gap: int = 1) -> DecisionInput:
    """Return a decision where `survivors` of the keyframe's 100 tracks moved by `flow` [px]."""
    x, y = np.divmod(np.arange(100.0), 10.0)
    pixels = 40.0 * np.column_stack([x, y])  # whole numbers: the flow is exact
    keyframe = certain_tracks(np.arange(100), pixels)
    newest = certain_tracks(np.arange(survivors), pixels[:survivors] + [flow, 0.0])
    return DecisionInput(OBSERVATION, keyframe, newest, gap)


@pytest.mark.parametrize(('change', 'forced'), [
    ({}, None), ({'survivors': 49}, True), ({'survivors': 50}, None), ({'survivors': 0}, True),
    ({'gap': 40}, True), ({'gap': 39}, None), ({'flow': 1.9}, False), ({'flow': 2.0}, None),
    ({'flow': 2.1}, None), ({'flow': 1.9, 'survivors': 49}, True),
    ({'flow': 0.0, 'gap': 40}, True)])
def test_extremes_are_forced(change, forced):
    assert KeyframeGuard().forced(decision(**change)) is forced


def test_without_tracks_only_the_gap_counts():
    for gap, forced in ((39, None), (40, True)):
        assert KeyframeGuard().forced(
            DecisionInput(OBSERVATION, Tracks(), Tracks(), gap)) is forced


@pytest.mark.parametrize(('survivors', 'forced'), [(7, True), (8, None)])
def test_too_few_tracks_to_measure_flow_keep(survivors, forced):
    guard = KeyframeGuard(min_survival=0.0, max_gap=None, min_flow=2.0)
    assert guard.forced(decision(survivors)) is forced


def test_no_guard_forces_nothing():
    assert not NO_GUARD.needs_tracks
    for change in ({'survivors': 0}, {'gap': 10 ** 9}, {'flow': 0.0}):
        assert NO_GUARD.forced(decision(**change)) is None


def test_a_guard_without_tracks_tests_the_gap_only():
    assert KeyframeGuard().needs_tracks
    guard = KeyframeGuard().without_tracks()
    assert not guard.needs_tracks
    assert guard.forced(decision(survivors=0)) is None
    assert guard.forced(decision(flow=0.0)) is None
    assert guard.forced(decision(gap=40)) is True


@pytest.mark.parametrize('wrong', [{'min_survival': 1.1}, {'max_gap': 0}, {'min_flow': -1.0},
                                   {'min_flow': float('nan')}])
def test_values_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match='expected a min_survival of 0 to 1'):
        KeyframeGuard(**wrong)
