# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Policies that a trained one is compared with, and the score of a policy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odometry_scenes import certain_tracks

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import DecisionInput
from kfvo_ros.keyframes.guard import NO_GUARD, KeyframeGuard
from kfvo_ros.keyframes.heuristics import EveryFrame, ParallaxPolicy, ParallaxRule
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.training.encoded_sequence import encode_sequence
from kfvo_ros.training.evaluation import GuardOnly, PolicyEvaluation, RandomPolicy

COUNT = 100
GUARD = KeyframeGuard(min_survival=0.5, max_gap=40, min_flow=2.0)
LAYOUT = (('flow', 1), ('track_survival', 1), ('baseline_to_depth', 1))
EXPERT = ParallaxRule(flow=12.0, baseline=0.03, survival=0.2)


def decision(flow: float, survivors: int = COUNT, gap: int = 1) -> DecisionInput:
    """Return a decision where `survivors` of the keyframe's tracks moved by `flow` [px]."""
    pixels = np.random.default_rng(0).uniform(0.0, 500.0, (COUNT, 2))
    observation = np.array([np.log1p(flow), survivors / COUNT, 0.0], dtype=np.float32)
    moved = pixels[:survivors] + [flow, 0.0]
    return DecisionInput(observation, certain_tracks(np.arange(COUNT), pixels),
                         certain_tracks(np.arange(survivors), moved), gap)


@pytest.mark.parametrize('policy', [GuardOnly(GUARD), RandomPolicy(GUARD, 0),
                                    ParallaxPolicy(LAYOUT, EXPERT, GUARD)])
def test_the_guard_decides_first(policy):
    assert policy.needs_tracks
    for _ in range(20):
        assert policy.decide(decision(10.0, survivors=COUNT // 4)) is True
        assert policy.decide(decision(10.0, gap=40)) is True
        assert policy.decide(decision(1.0)) is False


def test_guard_only_drops_what_is_not_forced():
    assert not any(GuardOnly(GUARD).decide(decision(flow)) for flow in (3.0, 30.0, 300.0))
    assert GuardOnly(NO_GUARD).decide(decision(0.0, survivors=0, gap=1000)) is False


def test_the_random_policy_keeps_half_of_the_frames_and_a_seed_repeats_it():
    runs = []
    for seed in (0, 0, 1):
        policy = RandomPolicy(GUARD, seed)
        runs.append([policy.decide(decision(10.0)) for _ in range(400)])
    assert runs[0] == runs[1] != runs[2]
    assert all(160 < sum(run) < 240 for run in runs)
    assert not RandomPolicy(NO_GUARD, 0).needs_tracks


def test_the_expert_decides_what_the_guard_does_not_force():
    policy = ParallaxPolicy(LAYOUT, EXPERT, GUARD)
    assert [policy.decide(decision(flow)) for flow in (3.0, 11.0, 13.0)] == [False, False, True]


@pytest.fixture(scope='module')
def evaluation() -> PolicyEvaluation:
    """Return an evaluation on two sequences of different lengths."""
    backbone = GeometricBackbone()
    return PolicyEvaluation([encode_sequence(SyntheticSequence(seed, 'smooth', frames), backbone)
                             for seed, frames in ((3, 20), (4, 30))],
                            backbone, factory.signature_of(OdometryOptions(), backbone))


def test_a_score_is_the_geometric_mean_error_and_the_share_of_all_frames(evaluation):
    calls = []
    total = evaluation.score(GuardOnly(GUARD), lambda: calls.append(None))
    first, second = evaluation.scores(GuardOnly(GUARD))
    assert len(calls) == 2 and first.ate_percent != second.ate_percent
    assert total.ate_percent == pytest.approx((first.ate_percent * second.ate_percent) ** 0.5)
    assert total.kept == pytest.approx((20 * first.kept + 30 * second.kept) / 50)
    assert evaluation.score(EveryFrame()).kept == 1.0 > total.kept


def test_a_sequence_that_never_moves_is_named(evaluation):
    at_rest = np.tile(np.eye(4), (20, 1, 1))
    still = replace(evaluation.sequences[0], name='still', T_truth_camera=at_rest)
    with pytest.raises(KfvoError, match='^still: the ground truth never moves'):
        replace(evaluation, sequences=[still]).score(EveryFrame())
