# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The learned policy: its network, its rail, its file, and where it may run."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from odometry_scenes import sure
from policies import ALWAYS, NEVER, random_actor, write_policy
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import DecisionInput, indices_of, layout_of
from kfvo_ros.keyframes.guard import NO_GUARD, KeyframeGuard
from kfvo_ros.keyframes.learned import (
    CLIP,
    KEY,
    Actor,
    Layer,
    Learned,
    PolicyFile,
    PolicySignature,
    find_policy,
    read_policy,
)
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions, VggtOptions
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.tracking.tracker import Tracks

LAYOUT = layout_of(48, 8, ('near', 'far'))
SIZE = 48 + 49 + 2
SETTING = PolicySignature('geometric', 'depth', 8, LAYOUT)


def decision(observation: np.ndarray, survivors: int = 80, flow: float = 10.0,
             gap: int = 1) -> DecisionInput:
    pixels = np.random.default_rng(3).uniform(50.0, 400.0, (100, 2))
    return DecisionInput(observation, sure(np.arange(100), pixels),
                         sure(np.arange(survivors), pixels[:survivors] + [flow, 0.0]), gap)


def test_the_network_is_the_one_that_torch_runs():
    torch = pytest.importorskip('torch', reason="torch is not installed: pip install torch")
    numbers = random_actor(SIZE)
    steps = [torch.nn.Linear(len(layer.weight[0]), len(layer.bias)) for layer in numbers.layers]
    for step, layer in zip(steps, numbers.layers):
        step.weight.data, step.bias.data = map(torch.tensor, (layer.weight, layer.bias))
    network = torch.nn.Sequential(steps[0], torch.nn.ReLU(), steps[1], torch.nn.ReLU(), steps[2])
    seen = np.random.default_rng(1).normal(0.0, 8.0, (1000, SIZE)).astype(np.float32)
    standard = ((torch.tensor(seen) - torch.tensor(numbers.mean)) / torch.tensor(numbers.std))
    expected = network(standard.clamp(-CLIP, CLIP).float()).detach().numpy()
    assert np.abs(numbers.logits(seen) - expected).max() < 1e-5 * np.abs(expected).max()
    assert (np.abs(standard.numpy()) > CLIP).any()


def test_a_tie_keeps_and_the_greater_preference_decides():
    dead = Layer(np.zeros((2, SIZE), np.float32), np.zeros(2, np.float32))
    blank = Actor(np.zeros(SIZE), np.ones(SIZE), (dead,))
    everything = np.arange(SIZE)
    observation = np.ones(SIZE, np.float32)
    assert Learned(blank, NO_GUARD, everything).decide(decision(observation))
    for bias, keeps in (([0.1, 0.0], False), ([0.0, 0.1], True)):
        biased = replace(blank, layers=(replace(dead, bias=np.array(bias, np.float32)),))
        assert Learned(biased, NO_GUARD, everything).decide(decision(observation)) is keeps


def test_a_policy_sees_only_its_own_parts():
    parts = (('far', 1), ('descriptor', 48))
    indices = indices_of(parts, LAYOUT)
    observation = np.arange(SIZE, dtype=np.float32)
    assert observation[indices].tolist() == [98.0, *range(48)]
    with pytest.raises(KeyError):
        indices_of((('descriptor', 1024),), LAYOUT)


@pytest.mark.parametrize(('change', 'forced'), [
    ({}, None), ({'survivors': 49}, True), ({'survivors': 51}, None), ({'survivors': 0}, True),
    ({'gap': 40}, True), ({'gap': 39}, None), ({'flow': 1.9}, False), ({'flow': 2.1}, None),
    ({'flow': 1.9, 'survivors': 49}, True), ({'flow': 0.0, 'gap': 40}, True)])
def test_the_rail_decides_at_the_extremes_alone(change, forced):
    assert KeyframeGuard().forced(decision(np.zeros(SIZE), **change)) is forced


def test_without_tracks_the_rail_knows_the_gap_only():
    bare = DecisionInput(np.zeros(SIZE), Tracks(), Tracks(), 39)
    assert KeyframeGuard().forced(bare) is None
    assert KeyframeGuard().forced(replace(bare, gap=40)) is True


def test_no_rail_forces_nothing():
    assert not NO_GUARD.needs_tracks
    for change in ({'survivors': 0}, {'gap': 10 ** 9}, {'flow': 0.0}):
        assert NO_GUARD.forced(decision(np.zeros(SIZE), **change)) is None
    left = KeyframeGuard().without_tracks()
    assert not left.needs_tracks and left.forced(decision(np.zeros(SIZE), survivors=0)) is None
    assert left.forced(decision(np.zeros(SIZE), gap=40)) is True
    nothing = indices_of(LAYOUT, LAYOUT)
    assert Learned(random_actor(SIZE), KeyframeGuard(), nothing).needs_tracks
    assert not Learned(random_actor(SIZE), left, nothing).needs_tracks


@pytest.mark.parametrize('wrong', [{'min_survival': 1.1}, {'max_gap': 0}, {'min_flow': -1.0},
                                   {'min_flow': float('nan')}])
def test_an_impossible_rail_is_refused(wrong):
    with pytest.raises(ValueError, match='expected a min_survival of 0 to 1'):
        KeyframeGuard(**wrong)


def test_a_file_holds_all_of_a_policy(tmp_path: Path):
    written = PolicyFile(random_actor(SIZE), KeyframeGuard(0.4, 30, 1.5), SETTING, {'steps': 5, 'seed': 1})
    written.write(tmp_path / 'policy.safetensors')
    read = read_policy(tmp_path / 'policy.safetensors')
    assert (read.rail, read.setting, read.training) == (
        written.rail, written.setting, written.training)
    seen = np.random.default_rng(2).normal(size=(20, SIZE)).astype(np.float32)
    np.testing.assert_array_equal(read.actor.logits(seen), written.actor.logits(seen))


@pytest.mark.parametrize(('change', 'words'), [
    ({'backbone': 'vggt'}, ('geometric', 'vggt')), ({'scale_rule': 'none'}, ('depth', 'none')),
    ({'window_size': 6}, ('8', '6')), ({'observation': LAYOUT[:-1]}, ('far',))])
def test_another_setting_is_refused_with_both_named(change, words):
    with pytest.raises(KfvoError) as refusal:
        PolicyFile(random_actor(SIZE), KeyframeGuard(), SETTING).policy(replace(SETTING, **change))
    assert all(word in str(refusal.value) for word in words)


def damage(path: Path, how: str) -> None:
    """Make a policy file a bad one."""
    PolicyFile(random_actor(SIZE), KeyframeGuard(), SETTING).write(path)
    tensors, head = load_file(path), {'format_version': 1}
    good = PolicyFile(random_actor(SIZE), KeyframeGuard(), SETTING)
    if how == 'cut':
        path.write_bytes(path.read_bytes()[:1000])
    elif how == 'text':
        path.write_text('a policy')
    elif how == 'other tensors':
        save_file(tensors, path)
    elif how == 'half a head':
        save_file(tensors, path, {KEY: json.dumps(head)})
    elif how == 'no json':
        save_file(tensors, path, {KEY: '{'})
    elif how == 'later version':
        save_file(tensors, path, {KEY: json.dumps({'format_version': 2})})
    elif how == 'deep json':
        save_file(tensors, path, {KEY: '[' * 100_000})
    elif how == 'bfloat16':
        text = json.dumps({
            '__metadata__': {KEY: json.dumps(head)},
            'mean': {'dtype': 'BF16', 'shape': [1], 'data_offsets': [0, 2]}}).encode()
        path.write_bytes(len(text).to_bytes(8, 'little') + text + bytes(2))
    elif how == 'not finite':
        replace(good, actor=replace(good.actor, mean=np.full(SIZE, np.nan))).write(path)
    elif how == 'no spread':
        replace(good, actor=replace(good.actor, std=np.zeros(SIZE))).write(path)
    elif how == 'wrong size':
        replace(good, actor=random_actor(SIZE + 1)).write(path)
    elif how == 'no layers':
        replace(good, actor=replace(good.actor, layers=())).write(path)


def refusal_of(path: Path) -> str:
    """Return the one line with which a file is refused."""
    with pytest.raises(KfvoError) as refusal:
        read_policy(path)
    line = str(refusal.value)
    assert str(path) in line and '\n' not in line
    assert 'expected a policy that kfvo_train wrote' in line
    return line


@pytest.mark.parametrize('how', [
    'cut', 'text', 'other tensors', 'half a head', 'no json', 'deep json', 'bfloat16',
    'later version', 'not finite', 'no spread', 'wrong size', 'no layers'])
def test_a_bad_file_is_one_clear_line(how, tmp_path: Path):
    path = tmp_path / 'policy.safetensors'
    damage(path, how)
    refusal_of(path)


@pytest.mark.parametrize(('part', 'change', 'problem'), [
    ('rail', {'max_gap': 'wide'}, "'wide'|not supported between"),
    ('rail', {'max_gap': 2.5}, 'max_gap: expected a whole number, came 2.5'),
    ('setting', {'backbone': 5}, 'backbone: expected a word, came 5'),
    ('setting', {'scale_rule': None}, 'scale_rule: expected a word, came None'),
    ('setting', {'window_size': '8'}, "window_size: expected a whole number, came '8'"),
    ('setting', {'window_size': True}, 'window_size: expected a whole number, came True'),
    ('setting', {'observation': [['far', float('inf')]]}, 'expected a whole number, came inf'),
    ('setting', {'observation': [['far', '99']]}, "expected a whole number, came '99'"),
    ('setting', {'observation': [[5, 99]]}, 'observation: expected a word, came 5'),
    (None, {'training': [1]}, r'training: expected a mapping, came \[1\]')])
def test_what_a_head_tells_is_of_its_kind(part, change, problem, tmp_path: Path):
    path = tmp_path / 'policy.safetensors'
    PolicyFile(random_actor(SIZE), KeyframeGuard(), SETTING).write(path)
    with safe_open(path, 'np') as file:
        head = json.loads(file.metadata()[KEY])
    (head if part is None else head[part]).update(change)
    save_file(load_file(path), path, {KEY: json.dumps(head)})
    assert re.search(problem, refusal_of(path))


def test_a_network_without_an_observation_is_refused(tmp_path: Path):
    path = tmp_path / 'policy.safetensors'
    layer = Layer(np.zeros((2, 0), np.float32), np.zeros(2, np.float32))
    PolicyFile(Actor(np.zeros(0), np.ones(0), (layer,)), KeyframeGuard(),
               replace(SETTING, observation=())).write(path)
    assert 'from 0 numbers' in refusal_of(path)


def test_missing_files_and_folders_are_named(tmp_path: Path):
    with pytest.raises(KfvoError, match='missing.safetensors'):
        read_policy(tmp_path / 'missing.safetensors')
    with pytest.raises(KfvoError, match='cannot write the policy'):
        PolicyFile(random_actor(SIZE), KeyframeGuard(), SETTING).write(
            tmp_path / 'nowhere' / 'policy.safetensors')


def test_a_policy_runs_with_the_backbone_it_was_trained_with(tmp_path: Path):
    path = tmp_path / 'policy.safetensors'
    options = OdometryOptions(keyframes='learned', policy=str(path))
    setting = factory.signature_of(options, factory.make_backbone(options, VggtOptions()))
    kept = []
    for bias in (ALWAYS, NEVER):
        write_policy(path, setting, bias)
        odometry = factory.make_odometry(options)
        kept.append(sum(odometry.process(frame).is_keyframe
                        for frame in SyntheticSequence(3, 'smooth', 40)))
    assert odometry.policy.name == 'learned'
    assert kept[0] == 40 and 7 < kept[1] < 20
    with pytest.raises(KfvoError, match='window_size'):
        factory.make_odometry(replace(options, window_size=6))


def test_a_policy_comes_with_the_geometric_backbone():
    options = OdometryOptions(keyframes='learned')
    told = read_policy(find_policy(None, 'geometric')).training
    assert {'command', 'seed', 'steps', 'recipe', 'sequences', 'scores'} <= set(told)
    odometry = factory.make_odometry(options)
    kept = sum(odometry.process(frame).is_keyframe
               for frame in SyntheticSequence(3, 'smooth', 40))
    assert odometry.policy.name == 'learned' and 7 < kept < 40
    for changes, misfit in (({'window_size': 6}, 'window_size 8'),
                            ({'scale_rule': 'translation'}, 'scale_rule depth')):
        with pytest.raises(KfvoError, match=misfit):
            factory.make_odometry(replace(options, **changes))


def test_a_backbone_without_a_policy_of_its_own_is_told_to_need_a_file():
    class Other(GeometricBackbone):
        name = 'other'

    with pytest.raises(KfvoError, match='no learned policy comes with the other backbone'):
        factory.make_odometry(OdometryOptions(keyframes='learned'), Other())
