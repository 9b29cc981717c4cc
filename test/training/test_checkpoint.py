# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: their keys, the plan they belong to, and safety of reading."""

from __future__ import annotations

import math
import os
import pickle
import random
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

import torch

from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.learned import PolicySignature
from kfvo_ros.odometry.options import SequenceOptions, VggtOptions
from kfvo_ros.training.checkpoint import Checkpoint, read_checkpoint
from kfvo_ros.training.config import read_training_config
from kfvo_ros.training.plan import TrainingPlan
from kfvo_ros.utils.config import to_mapping

SIGNATURE = PolicySignature('geometric', 'depth', 8, (('descriptor', 48), ('poses', 49)))


@pytest.fixture(autouse=True)
def working_folder(tmp_path, monkeypatch) -> None:
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def plan() -> TrainingPlan:
    return TrainingPlan(('synthetic:1',), (), 0, SIGNATURE, read_training_config('train.yaml'),
                        SequenceOptions(), VggtOptions())


class MaliciousPickle:
    """Writes a file when it is unpickled."""

    def __reduce__(self):
        return open, ('sprung', 'w')


@pytest.mark.filterwarnings('ignore:Detected pickle protocol')
@pytest.mark.parametrize('how', ['pickle', 'torch', 'text', 'empty', 'tensor', 'version', 'cut',
                                 'number'])
def test_a_bad_checkpoint_is_one_clear_line_and_never_unpickled(how, plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    good = {'format_version': 1, 'plan': {}, 'steps': 1, 'best': 1.0, 'parameters': {},
            'statistics': {}}
    if how == 'pickle':
        path.write_bytes(pickle.dumps(good | {'plan': MaliciousPickle()}))
    elif how == 'torch':
        torch.save(good | {'plan': MaliciousPickle()}, path)
    elif how == 'tensor':
        torch.save(torch.zeros(3), path)
    elif how == 'version':
        torch.save(good | {'format_version': 2}, path)
    elif how == 'cut':
        torch.save(good, path)
        path.write_bytes(path.read_bytes()[:200])
    elif how == 'number':
        torch.save(good | {'plan': 5}, path)
    else:
        path.write_text('a checkpoint' if how == 'text' else '')
    with pytest.raises(KfvoError) as refusal:
        read_checkpoint(path, plan)
    line = str(refusal.value)
    assert str(path) in line and 'expected a checkpoint that kfvo_train wrote' in line
    assert '\n' not in line and not (tmp_path / 'sprung').exists()


@pytest.mark.parametrize('change', [
    {'seed': torch.zeros(2)}, {'sequences': (torch.zeros(2),)}, {'setting': {'observation': {1}}},
    {7: 'seven'}])
def test_a_plan_that_is_not_plain_is_one_clear_line(change, plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    Checkpoint(to_mapping(plan) | change, 5, 1.0, {}, {}).write(path)
    with pytest.raises(KfvoError, match='expected a checkpoint that kfvo_train wrote') as refusal:
        read_checkpoint(path, plan)
    assert '\n' not in str(refusal.value)


def test_a_checkpoint_resumes_under_the_same_plan_only(plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    Checkpoint(to_mapping(plan), 5, 1.0, {}, {}).write(path)
    longer = replace(plan, recipe=replace(plan.recipe, steps=7, validation_every=1))
    moved = replace(plan, vggt=VggtOptions(device='cpu', recompute=True, compile=True))
    for same in (plan, longer, moved):
        assert read_checkpoint(path, same).steps == 5
    ppo = replace(plan.recipe.ppo, gamma=0.5)
    smaller = replace(SIGNATURE, observation=SIGNATURE.observation[:1])
    for other, words in (
            (replace(plan, recipe=replace(plan.recipe, ppo=ppo)),
             f'recipe.ppo.gamma was {plan.recipe.ppo.gamma}'),
            (replace(plan, signature=smaller), 'setting.observation was'),
            (replace(plan, seed=3), 'seed was 0, now 3'),
            (replace(plan, recipe=replace(plan.recipe, guard=None)), 'recipe.rail was'),
            (replace(plan, sequence_options=SequenceOptions(stop=9)),
             'reading.stop was None, now 9'),
            (replace(plan, sequence_options=SequenceOptions(camera='my.yaml', rate=20.0)),
             "reading.camera was None, now 'my.yaml'; reading.rate was 10.0, now 20.0"),
            (replace(plan, vggt=VggtOptions('my.pt')), "vggt.weights was 'facebook/VGGT-1B'"),
            (replace(plan, sequences=('synthetic:2',)), 'sequences was')):
        with pytest.raises(KfvoError, match='is of another training') as refusal:
            read_checkpoint(path, other)
        assert words in str(refusal.value) and '\n' not in str(refusal.value)


def test_a_checkpoint_of_an_older_version_may_lack_keys(plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    older = {key: value for key, value in to_mapping(plan).items()
             if key not in ('reading', 'vggt')}
    Checkpoint(older, 5, 1.0, {}, {}).write(path)
    assert read_checkpoint(path, plan).steps == 5


def flip(path: Path, content: bytes, bit: int) -> None:
    """Write the content with one bit flipped."""
    changed = bytearray(content)
    changed[bit // 8] ^= 1 << bit % 8
    path.write_bytes(changed)


def refusal_of(path: Path, plan: TrainingPlan) -> str:
    """Return the one line with which a checkpoint is refused."""
    with pytest.raises(KfvoError) as refusal:
        read_checkpoint(path, plan)
    line = str(refusal.value)
    assert str(path) in line and len(line.splitlines()) == 1
    return line


TENSORS = {'policy': {'weight': torch.linspace(-1.0, 1.0, 999), 'bias': torch.zeros(3)},
           'policy.optimizer': {'state': {0: {'step': torch.tensor(4.0)}}, 'param_groups': [
               {'lr': 3e-4, 'betas': (0.9, 0.999), 'params': [0], 'foreach': None}]}}
STATISTICS = {'returns': {'mean': torch.zeros(()), 'var': torch.ones(()), 'count': 4.0}}


def test_every_flipped_bit_is_found(plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    Checkpoint(to_mapping(plan), 5, math.inf, TENSORS, STATISTICS).write(path)
    content, rng, named = path.read_bytes(), random.Random(0), 0
    for _ in range(200):
        flip(path, content, rng.randrange(8 * len(content)))
        named += 'it is damaged, its SHA-256 is not the stored one: copy it again, or replace' \
            in refusal_of(path, plan)
    assert named >= 190  # others are no ZIP files any more
    for size in (len(content) - 1, len(content) - 71, len(content) // 2, 100):
        path.write_bytes(content[:size])
        refusal_of(path, plan)
    path.write_bytes(content)
    assert torch.equal(read_checkpoint(path, plan).parameters['policy']['weight'],
                       TENSORS['policy']['weight'])
    assert torch.load(path, weights_only=True)['steps'] == 5


def test_a_checkpoint_of_an_older_version_has_no_digest(plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    torch.save({'format_version': 1} | vars(Checkpoint(to_mapping(plan), 5, 1.0, TENSORS,
                                                       STATISTICS)), path)
    assert read_checkpoint(path, plan).steps == 5
    content = path.read_bytes()
    weights = TENSORS['policy']['weight'].numpy().tobytes()
    flip(path, content, 8 * content.index(weights) + 5)
    assert 'its CRC-32 is not the stored one' in refusal_of(path, plan)


@pytest.mark.parametrize('change', [
    {'parameters': {'policy': {'bias': torch.tensor([0.0, math.nan])}}},
    {'parameters': {'policy.optimizer': {'param_groups': [{'lr': math.inf}]}}},
    {'parameters': {'policy': {'bias': torch.tensor([1e30])}}},
    {'statistics': {'returns': {'count': -1e300}}},
    {'statistics': {'returns': {'var': torch.tensor([-math.inf])}}},
    {'steps': -1}, {'steps': 10 ** 30}, {'steps': True}, {'best': math.nan}, {'best': 1}])
def test_numbers_that_no_training_has_are_refused(change, plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    replace(Checkpoint(to_mapping(plan), 5, 1.0, TENSORS, STATISTICS), **change).write(path)
    line = refusal_of(path, plan)
    assert 'expected a checkpoint that kfvo_train wrote' in line
    if not change.keys() & {'steps', 'best'}:
        assert 'numbers up to 1e+12 are needed' in line and '--overwrite' in line


def test_a_fifo_is_not_waited_for(plan, tmp_path):
    os.mkfifo(tmp_path / 'checkpoint.pt')
    assert 'expected a file, found a FIFO' in refusal_of(tmp_path / 'checkpoint.pt', plan)


def test_a_checkpoint_has_the_keys_of_the_first_version(plan):
    mapping = to_mapping(plan)
    assert list(mapping) == ['sequences', 'validation', 'seed', 'setting', 'recipe', 'reading',
                             'vggt']
    assert list(mapping['setting']) == ['backbone', 'scale_rule', 'window_size', 'observation']
    assert {'rail', 'teacher', 'imitation', 'without'} < set(mapping['recipe'])
    assert list(mapping['reading']) == ['kind', 'camera', 'image_topic', 'ground_truth_topic',
                                        'ground_truth_to_camera', 'rate', 'stop']
