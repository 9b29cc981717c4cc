# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Learned policy: network, file format and compatibility with an odometry."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policies import ALWAYS, NEVER, random_actor, write_policy
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import DecisionInput, layout_of
from kfvo_ros.keyframes.guard import NO_GUARD, KeyframeGuard
from kfvo_ros.keyframes.learned import (
    CLIP,
    METADATA_KEY,
    Actor,
    Layer,
    LearnedPolicy,
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
SIGNATURE = PolicySignature('geometric', 'depth', 8, LAYOUT)


def decide(actor: Actor, observation: np.ndarray) -> bool:
    """Return the decision of a policy that sees the whole observation, without a guard."""
    policy = LearnedPolicy(actor, NO_GUARD, np.arange(len(observation)))
    return policy.decide(DecisionInput(observation, Tracks(), Tracks(), 1))


def test_the_network_equals_its_torch_counterpart():
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


@pytest.mark.parametrize(('bias', 'keeps'), [
    ([0.0, 0.0], True), ([0.1, 0.0], False), ([0.0, 0.1], True)])
def test_the_greater_logit_decides_and_a_tie_keeps(bias, keeps):
    layer = Layer(np.zeros((2, SIZE), np.float32), np.array(bias, np.float32))
    actor = Actor(np.zeros(SIZE), np.ones(SIZE), (layer,))
    assert decide(actor, np.ones(SIZE, np.float32)) is keeps


def difference_actor(clip: float) -> Actor:
    """Return an actor that keeps where the first input, clipped, is at least the second."""
    layer = Layer(np.array([[0.0, 1.0], [1.0, 0.0]], np.float32), np.zeros(2, np.float32))
    return Actor(np.array([1.0, 0.0]), np.array([2.0, 1.0]), (layer,), clip)


@pytest.mark.parametrize('clip', [CLIP, 3.0])
def test_standardised_observations_are_clipped(clip):
    """The first input is (value - 1) / 2."""
    actor = difference_actor(clip)
    inputs = [[1.0 + 2.0 * factor * clip, 0.0] for factor in (0.99, 1.0, 1.01, 1e6, -1.01, -1e6)]
    np.testing.assert_allclose(actor.logits(np.array(inputs))[:, 1] / clip,
                               [0.99, 1.0, 1.0, 1.0, -1.0, -1.0], rtol=1e-6)
    # Beyond the clip both inputs are equal, which keeps; just inside, the second is greater.
    assert decide(actor, np.array([1.0 + 2.0 * clip, 5.0 * clip], np.float32)) is True
    assert decide(actor, np.array([1.0 + 1.98 * clip, 5.0 * clip], np.float32)) is False


def test_a_file_stores_the_clip(tmp_path: Path):
    path = tmp_path / 'policy.safetensors'
    signature = replace(SIGNATURE, observation=(('near', 1), ('far', 1)))
    PolicyFile(difference_actor(3.0), NO_GUARD, signature).write(path)
    assert metadata_of(path)['clip'] == 3.0
    actor = read_policy(path).actor
    assert actor.clip == 3.0
    assert actor.logits(np.array([100.0, 5.0])).tolist() == [3.0, 3.0]


def test_a_file_without_a_clip_is_clipped_at_ten(tmp_path: Path):
    """Files of version 0.1 store none."""
    path = tmp_path / 'policy.safetensors'
    signature = replace(SIGNATURE, observation=(('near', 1), ('far', 1)))
    PolicyFile(difference_actor(3.0), NO_GUARD, signature).write(path)
    metadata = metadata_of(path)
    del metadata['clip']
    save_file(load_file(path), path, {METADATA_KEY: json.dumps(metadata)})
    actor = read_policy(path).actor
    assert actor.clip == 10.0
    assert actor.logits(np.array([100.0, 5.0])).tolist() == [5.0, 10.0]


@pytest.mark.parametrize('guard', [KeyframeGuard(), NO_GUARD])
def test_a_policy_needs_the_tracks_of_its_guard(guard):
    policy = LearnedPolicy(random_actor(SIZE), guard, np.arange(SIZE))
    assert policy.needs_tracks is guard.needs_tracks


def test_the_guard_decides_before_the_network():
    layer = Layer(np.zeros((2, SIZE), np.float32), np.array(NEVER, np.float32))
    actor = Actor(np.zeros(SIZE), np.ones(SIZE), (layer,))
    policy = LearnedPolicy(actor, KeyframeGuard(0.0, 5, 0.0), np.arange(SIZE))
    observation = np.zeros(SIZE, np.float32)
    assert [policy.decide(DecisionInput(observation, Tracks(), Tracks(), gap))
            for gap in (4, 5)] == [False, True]


def test_a_file_round_trip_preserves_the_policy(tmp_path: Path):
    written = PolicyFile(random_actor(SIZE), KeyframeGuard(0.4, 30, 1.5), SIGNATURE,
                         {'steps': 5, 'seed': 1})
    written.write(tmp_path / 'policy.safetensors')
    read = read_policy(tmp_path / 'policy.safetensors')
    assert (read.guard, read.signature, read.training) == (
        written.guard, written.signature, written.training)
    seen = np.random.default_rng(2).normal(size=(20, SIZE)).astype(np.float32)
    np.testing.assert_array_equal(read.actor.logits(seen), written.actor.logits(seen))


@pytest.mark.parametrize(('change', 'words'), [
    ({'backbone': 'vggt'}, ('geometric', 'vggt')), ({'scale_rule': 'none'}, ('depth', 'none')),
    ({'window_size': 6}, ('8', '6')), ({'observation': LAYOUT[:-1]}, ('far',))])
def test_another_signature_is_refused_with_both_named(change, words):
    file = PolicyFile(random_actor(SIZE), KeyframeGuard(), SIGNATURE)
    with pytest.raises(KfvoError) as refusal:
        file.policy(replace(SIGNATURE, **change))
    assert all(word in str(refusal.value) for word in words)


def metadata_of(path: Path) -> dict[str, Any]:
    """Return the policy's metadata in a file."""
    with safe_open(path, 'np') as file:
        return json.loads(file.metadata()[METADATA_KEY])


def write_damaged(path: Path, how: str) -> None:
    """Write a policy file with a defect."""
    good = PolicyFile(random_actor(SIZE), KeyframeGuard(), SIGNATURE)
    good.write(path)
    tensors, head = load_file(path), {'format_version': 1}
    if how == 'cut':
        path.write_bytes(path.read_bytes()[:1000])
    elif how == 'text':
        path.write_text('a policy')
    elif how == 'other tensors':
        save_file(tensors, path)
    elif how == 'half a head':
        save_file(tensors, path, {METADATA_KEY: json.dumps(head)})
    elif how == 'no json':
        save_file(tensors, path, {METADATA_KEY: '{'})
    elif how == 'later version':
        save_file(tensors, path, {METADATA_KEY: json.dumps({'format_version': 2})})
    elif how == 'deep json':
        save_file(tensors, path, {METADATA_KEY: '[' * 100_000})
    elif how == 'bfloat16':
        text = json.dumps({
            '__metadata__': {METADATA_KEY: json.dumps(head)},
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
    """Return the message with which a file is refused, one line that names it."""
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
    write_damaged(path, how)
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
    (None, {'training': [1]}, r'training: expected a mapping, came \[1\]'),
    (None, {'clip': '10'}, "clip: expected a decimal number, came '10'"),
    (None, {'clip': 0.0}, 'clip: expected a finite number above 0, came 0.0'),
    (None, {'clip': float('nan')}, 'clip: expected a finite number above 0, came nan'),
    (None, {'clip': float('inf')}, 'clip: expected a finite number above 0, came inf')])
def test_metadata_of_a_wrong_type_or_range_is_refused(part, change, problem, tmp_path: Path):
    path = tmp_path / 'policy.safetensors'
    PolicyFile(random_actor(SIZE), KeyframeGuard(), SIGNATURE).write(path)
    head = metadata_of(path)
    (head if part is None else head[part]).update(change)
    save_file(load_file(path), path, {METADATA_KEY: json.dumps(head)})
    assert re.search(problem, refusal_of(path))


def test_a_network_without_inputs_is_refused(tmp_path: Path):
    path = tmp_path / 'policy.safetensors'
    layer = Layer(np.zeros((2, 0), np.float32), np.zeros(2, np.float32))
    PolicyFile(Actor(np.zeros(0), np.ones(0), (layer,)), KeyframeGuard(),
               replace(SIGNATURE, observation=())).write(path)
    assert 'from 0 numbers' in refusal_of(path)


def test_missing_files_and_folders_are_named(tmp_path: Path):
    with pytest.raises(KfvoError, match='missing.safetensors'):
        read_policy(tmp_path / 'missing.safetensors')
    with pytest.raises(KfvoError, match='cannot write the policy'):
        PolicyFile(random_actor(SIZE), KeyframeGuard(), SIGNATURE).write(
            tmp_path / 'nowhere' / 'policy.safetensors')


def test_a_policy_runs_with_a_matching_backbone(tmp_path: Path):
    path = tmp_path / 'policy.safetensors'
    options = OdometryOptions(keyframes='learned', policy=str(path))
    signature = factory.signature_of(options, factory.make_backbone(options, VggtOptions()))
    kept = []
    for bias in (ALWAYS, NEVER):
        write_policy(path, signature, bias)
        odometry = factory.make_odometry(options)
        kept.append(sum(odometry.process(frame).is_keyframe
                        for frame in SyntheticSequence(3, 'smooth', 40)))
    assert odometry.policy.name == 'learned'
    assert kept[0] == 40 and 7 < kept[1] < 20
    with pytest.raises(KfvoError, match='window_size'):
        factory.make_odometry(replace(options, window_size=6))


def test_the_geometric_backbone_has_a_bundled_policy():
    options = OdometryOptions(keyframes='learned')
    training = read_policy(find_policy(None, 'geometric')).training
    assert {'command', 'seed', 'steps', 'recipe', 'sequences', 'scores'} <= set(training)
    odometry = factory.make_odometry(options)
    kept = sum(odometry.process(frame).is_keyframe
               for frame in SyntheticSequence(3, 'smooth', 40))
    assert odometry.policy.name == 'learned' and 7 < kept < 40
    for changes, mismatch in (({'window_size': 6}, 'window_size 8'),
                              ({'scale_rule': 'translation'}, 'scale_rule depth')):
        with pytest.raises(KfvoError, match=mismatch):
            factory.make_odometry(replace(options, **changes))


def test_a_backbone_without_a_bundled_policy_needs_a_file():
    class Other(GeometricBackbone):
        name = 'other'

    with pytest.raises(KfvoError, match='no learned policy comes with the other backbone'):
        factory.make_odometry(OdometryOptions(keyframes='learned'), Other())
