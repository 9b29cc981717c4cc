# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe policies by rule, at and around their thresholds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from odometry_scenes import certain_tracks

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes import HEURISTICS, POLICIES
from kfvo_ros.keyframes.base import DecisionInput
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.keyframes.heuristics import (
    PARALLAX_GUARD,
    PARALLAX_RULE,
    EveryFrame,
    OpticalFlow,
    ParallaxPolicy,
    ParallaxRule,
    Survival,
)
from kfvo_ros.keyframes.learned import LearnedPolicy
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.tracking.tracker import Tracks

COUNT = 100
LAYOUT = (('flow', 1), ('track_survival', 1), ('gap', 1), ('baseline_to_depth', 1))
CONFIG = Path(__file__).resolve().parents[2] / 'config' / 'train.yaml'


def decision(flow: float = 0.0, survivors: int = COUNT, start: int = COUNT, gap: int = 1,
             baseline: float = 0.0) -> DecisionInput:
    """Return a decision where `survivors` of the keyframe's `start` tracks moved by `flow` [px].

    Pixels are whole numbers, so the mean flow is exact for whole flows. The observation has the
    LAYOUT of the geometric backbone's signals.
    """
    row, column = np.divmod(np.arange(float(start)), 10.0)
    keyframe = certain_tracks(np.arange(start), 40.0 * np.column_stack([column, row]))
    shift = np.where(np.arange(survivors)[:, None] % 2, [flow, 0.0], [0.0, -flow])
    new = certain_tracks(1000 + np.arange(50), np.zeros((50, 2)))
    newest = Tracks(np.concatenate([np.arange(survivors), new.ids]),
                    np.concatenate([keyframe.pixels[:survivors] + shift, new.pixels]),
                    np.zeros(survivors + 50))
    observation = [np.log1p(flow), survivors / max(start, 1), gap, baseline]
    return DecisionInput(np.array(observation, dtype=np.float32), keyframe, newest, gap)


def test_names():
    policies = (EveryFrame, OpticalFlow, Survival, ParallaxPolicy, LearnedPolicy)
    assert tuple(policy.name for policy in policies) == POLICIES
    assert HEURISTICS == ('every', 'optical_flow', 'survival')


def test_every_frame_keeps_without_tracks():
    assert EveryFrame().decide(DecisionInput(np.zeros(1), None, None, 1)) is True
    assert not EveryFrame.needs_tracks
    assert OpticalFlow.needs_tracks
    assert Survival.needs_tracks


@pytest.mark.parametrize(('threshold', 'flow', 'keep'), [
    (50.0, 49.9, False), (50.0, 50.0, False), (50.0, 50.1, True), (50.0, 0.0, False),
    (20.0, 19.9, False), (20.0, 20.0, False), (20.0, 20.1, True)])
def test_optical_flow_keeps_above_the_threshold(threshold, flow, keep):
    assert OpticalFlow(threshold).decide(decision(flow)) == keep


def test_default_thresholds():
    """The paper's VGGT-LK uses 50 px."""
    assert OpticalFlow().threshold == 50.0
    assert (Survival().share, Survival().min_flow) == (0.8, 2.0)


@pytest.mark.parametrize(('share', 'survivors', 'keep'), [
    (0.8, 80, False), (0.8, 79, True), (0.8, 100, False), (0.8, 20, True),
    (0.5, 51, False), (0.5, 50, False), (0.5, 49, True)])
def test_survival_keeps_below_the_share(share, survivors, keep):
    assert Survival(share).decide(decision(10.0, survivors)) == keep


@pytest.mark.parametrize(('flow', 'keep'), [(0.0, False), (1.9, False), (2.0, True), (2.1, True)])
def test_survival_needs_the_minimum_flow(flow, keep):
    assert Survival().decide(decision(flow, survivors=30)) == keep


@pytest.mark.parametrize('policy', [OpticalFlow(), Survival()])
@pytest.mark.parametrize(('survivors', 'keep'), [(0, True), (7, True), (8, False)])
def test_fewer_than_eight_tracks_keep(policy, survivors, keep):
    assert policy.decide(decision(0.0, survivors)) is keep


@pytest.mark.parametrize('policy', [OpticalFlow(), Survival()])
def test_a_keyframe_without_tracks_keeps(policy):
    assert policy.decide(decision(0.0, 0, start=0)) is True


@pytest.mark.parametrize(('signals', 'keep'), [
    ({'flow': 0.0, 'baseline': 0.25, 'survival': 0.25}, False),  # all at their thresholds
    ({'flow': 1e-6, 'baseline': 0.25, 'survival': 0.25}, True),
    ({'flow': 0.0, 'baseline': 0.2501, 'survival': 0.25}, True),
    ({'flow': 0.0, 'baseline': 0.25, 'survival': 0.2499}, True),
    ({'flow': 0.0, 'baseline': 0.0, 'survival': 1.0}, False)])
def test_parallax_rule_compares_each_signal(signals, keep):
    rule = ParallaxRule(flow=0.0, baseline=0.25, survival=0.25)
    observations = np.array([[signals['flow'], signals['survival'], 3.0, signals['baseline']]],
                            dtype=np.float32)
    assert rule.decide(observations, LAYOUT).tolist() == [int(keep)]


def test_parallax_defaults_are_those_of_the_training():
    config = yaml.safe_load(CONFIG.read_text())
    assert ParallaxRule(**config['teacher']) == PARALLAX_RULE
    assert KeyframeGuard(**config['rail']) == PARALLAX_GUARD


@pytest.mark.parametrize(('change', 'keep'), [
    ({'flow': 49.9}, False), ({'flow': 50.1}, True),
    ({'flow': 10.0, 'baseline': 0.0199}, False), ({'flow': 10.0, 'baseline': 0.0201}, True),
    ({'flow': 10.0, 'survivors': 20}, False), ({'flow': 10.0, 'survivors': 19}, True),
    ({'flow': 10.0, 'gap': 59}, False), ({'flow': 10.0, 'gap': 60}, True),  # the guard's
    ({'flow': 1.9, 'baseline': 0.5}, False), ({'flow': 2.0, 'baseline': 0.5}, True),
    ({'flow': 1.9, 'survivors': 15}, False), ({'flow': 1.9, 'survivors': 14}, True),
    ({'flow': 0.0, 'gap': 60}, True), ({'flow': 0.0, 'survivors': 0}, True)])
def test_parallax_policy_is_the_rule_inside_the_guard(change, keep):
    assert ParallaxPolicy(LAYOUT).decide(decision(**change)) is keep


def expected_decision(seen: DecisionInput, layout: dict[str, int]) -> bool:
    """Return the parallax decision from tracks and observation, written independently."""
    last, newest = (dict(zip(tracks.ids.tolist(), tracks.pixels, strict=True))
                    for tracks in (seen.keyframe_tracks, seen.newest_tracks))
    flows = [float(np.linalg.norm(newest[track] - last[track])) for track in last.keys() & newest]
    if seen.gap >= 60 or len(flows) < max(8, 0.15 * len(last)):
        return True
    if np.mean(flows) < 2.0:
        return False
    flow, baseline, survival = (float(seen.observation[layout[name]]) for name in (
        'flow', 'baseline_to_depth', 'track_survival'))
    return np.expm1(flow) > 50.0 or baseline > 0.02 or survival < 0.2


def test_parallax_policy_in_an_odometry(monkeypatch):
    """Every decision of a run is the expected one; the camera moves, then rests."""
    odometry = factory.make_odometry(OdometryOptions(keyframes='parallax'))
    layout = factory.signature_of(OdometryOptions(), odometry.backbone).observation
    ends = dict(zip((name for name, _ in layout), np.cumsum([size for _, size in layout])))
    columns = {name: int(end) - 1 for name, end in ends.items()}
    decisions, decide = [], ParallaxPolicy.decide

    def recording(policy, seen):
        decisions.append((seen, decide(policy, seen)))
        return decisions[-1][1]

    monkeypatch.setattr(ParallaxPolicy, 'decide', recording)
    frames = list(SyntheticSequence(3, 'smooth', 60))
    frames += [replace(frames[-1], stamp_ns=frames[-1].stamp_ns + step * 50_000_000)
               for step in range(1, 70)]
    kept = [odometry.process(frame).is_keyframe for frame in frames]
    assert kept[:7] == [True] * 7 and kept[7:] == [keep for _, keep in decisions]
    assert [keep for _, keep in decisions] == [
        expected_decision(seen, columns) for seen, _ in decisions]
    assert 20 < sum(kept[:60]) < 45
    assert sum(kept[60:]) == 1  # at rest the guard drops until the gap is 60 frames
    assert np.diff(np.flatnonzero(kept))[-1] == 60


def test_parallax_policy_needs_the_signals_of_the_backbone():
    class FlowOnly(GeometricBackbone):
        name = 'flow_only'
        signal_names = ('flow',)

    with pytest.raises(KfvoError, match='signals baseline_to_depth and track_survival, which '
                       'flow_only does not offer'):
        factory.make_odometry(OdometryOptions(keyframes='parallax'), FlowOnly())
