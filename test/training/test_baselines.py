# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Policies that learned nothing, inside a rail."""

from __future__ import annotations

import numpy as np
import pytest
from odometry_scenes import sure

from kfvo_ros.keyframes.base import DecisionInput
from kfvo_ros.keyframes.guard import NO_GUARD, KeyframeGuard
from kfvo_ros.keyframes.heuristics import ParallaxRule
from kfvo_ros.training.baselines import ExpertPolicy, GuardOnly, RandomPolicy

COUNT = 100
RAIL = KeyframeGuard(min_survival=0.5, max_gap=40, min_flow=2.0)
LAYOUT = (('flow', 1), ('track_survival', 1), ('baseline_to_depth', 1))
TEACHER = ParallaxRule(flow=12.0, baseline=0.03, survival=0.2)


def decision(flow: float, survivors: int = COUNT, gap: int = 1) -> DecisionInput:
    """Return a decision where `survivors` of the keyframe's tracks moved by `flow` [px]."""
    pixels = np.random.default_rng(0).uniform(0.0, 500.0, (COUNT, 2))
    observation = np.array([np.log1p(flow), survivors / COUNT, 0.0], dtype=np.float32)
    return DecisionInput(observation, sure(np.arange(COUNT), pixels),
                         sure(np.arange(survivors), pixels[:survivors] + [flow, 0.0]), gap)


@pytest.mark.parametrize('policy', [GuardOnly(RAIL), RandomPolicy(RAIL, 0),
                                    ExpertPolicy(RAIL, TEACHER, LAYOUT)])
def test_the_rail_decides_first(policy):
    assert policy.needs_tracks
    for _ in range(20):
        assert policy.decide(decision(10.0, survivors=COUNT // 4)) is True
        assert policy.decide(decision(10.0, gap=40)) is True
        assert policy.decide(decision(1.0)) is False


def test_the_rail_alone_drops_all_that_is_left_open():
    assert not any(GuardOnly(RAIL).decide(decision(flow)) for flow in (3.0, 30.0, 300.0))
    assert GuardOnly(NO_GUARD).decide(decision(0.0, survivors=0, gap=1000)) is False


def test_chance_keeps_every_second_frame_and_a_seed_repeats_it():
    runs = []
    for seed in (0, 0, 1):
        policy = RandomPolicy(RAIL, seed)
        runs.append([policy.decide(decision(10.0)) for _ in range(400)])
    assert runs[0] == runs[1] != runs[2]
    assert all(160 < sum(run) < 240 for run in runs)
    assert not RandomPolicy(NO_GUARD, 0).needs_tracks


def test_where_the_rail_leaves_it_open_the_teacher_decides():
    policy = ExpertPolicy(RAIL, TEACHER, LAYOUT)
    assert [policy.decide(decision(flow)) for flow in (3.0, 11.0, 13.0)] == [False, False, True]
