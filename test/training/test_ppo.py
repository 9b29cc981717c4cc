# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The trained and the exported policy, and trainings with what the geometric backbone lacks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

import torch

from kfvo_ros import run, train
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import indices_of
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.keyframes.learned import CLIP, KEEP, read_policy
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.training.checkpoint import Checkpoint, read_checkpoint, statistics_of
from kfvo_ros.training.config import read_training_config
from kfvo_ros.training.env import OBSERVATION, PRIVILEGED
from kfvo_ros.training.plan import TrainingSetup
from kfvo_ros.training.policy_network import export_actor
from kfvo_ros.training.ppo import EPSILON, make_model
from kfvo_ros.training.sampler import make_environment

pytestmark = pytest.mark.usefixtures('own_signals')


@pytest.fixture(scope='module')
def learned():
    """Return a model that learned a little, and its plan."""
    recipe = read_training_config('train.yaml').shortened()
    recipe = replace(recipe, ppo=replace(recipe.ppo, n_steps=32))
    backbone = GeometricBackbone()
    choices = TrainingSetup(0, recipe, OdometryOptions(), SequenceOptions(stop=30), VggtOptions(), None)
    plan = choices.plan(['synthetic:1:smooth'], [], backbone)
    environment = make_environment(choices.lesson(plan), 2, 1, 0)
    model = make_model(environment, plan.recipe, 0)
    model.learn(128)
    return model, plan


@pytest.fixture(scope='module')
def learner(learned):
    return learned[0]


def test_a_checkpoint_brings_everything_back(learned, tmp_path):
    learner, plan = learned
    path = tmp_path / 'checkpoint.pt'
    Checkpoint.of(learner, plan, 128, 0.5).write(path)
    read = read_checkpoint(path, plan)
    fresh = make_model(learner.get_vec_normalize_env().unwrapped, plan.recipe, 1)
    read.restore(fresh)
    assert fresh.num_timesteps == 128 and read.best == 0.5
    for name, seen in statistics_of(learner).items():
        back = statistics_of(fresh)[name]
        np.testing.assert_array_equal(back.mean, seen.mean)
        np.testing.assert_array_equal(back.var, seen.var)
        assert back.count == seen.count
    stored, restored = learner.get_parameters(), fresh.get_parameters()
    for name, tensor in stored['policy'].items():
        assert torch.equal(tensor, restored['policy'][name])
    for number, state in stored['policy.optimizer']['state'].items():
        again = restored['policy.optimizer']['state'][number]
        assert all(torch.equal(value, again[name]) for name, value in state.items())


@pytest.mark.parametrize('change', [
    {'parameters': {}}, {'statistics': {}},
    {'parameters': {'policy': {}, 'policy.optimizer': {}}}, {'parameters': {'__init__': {}}}])
def test_a_checkpoint_that_does_not_fit_is_one_clear_line(learned, change):
    learner, plan = learned
    bad = replace(Checkpoint.of(learner, plan, 128, 0.5), **change)
    with pytest.raises(KfvoError, match='the checkpoint does not fit') as refusal:
        bad.restore(make_model(learner.get_vec_normalize_env().unwrapped, plan.recipe, 1))
    assert '\n' not in str(refusal.value)


def test_the_exported_actor_is_the_trained_one(learner):
    normalise = learner.get_vec_normalize_env()
    seen = normalise.obs_rms[OBSERVATION]
    random = np.random.default_rng(0)
    raw = random.normal(seen.mean, 4.0 * np.sqrt(seen.var), (1000, len(seen.mean)))
    raw = raw.astype(np.float32)
    known = normalise.normalize_obs({OBSERVATION: raw, PRIVILEGED: np.zeros(
        (1000, len(normalise.obs_rms[PRIVILEGED].mean)), np.float32)})
    assert np.abs(known[OBSERVATION]).max() == CLIP
    with torch.no_grad():
        expected = learner.policy.get_distribution(
            learner.policy.obs_to_tensor(known)[0]).distribution.logits.numpy()
    logits = export_actor(learner.policy, seen, EPSILON).logits(raw).astype(np.float64)
    found = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
    assert np.abs(found - expected).max() < 1e-6
    assert expected[:, KEEP].std() > 1e-3  # it says something of what it sees


def test_vggt_learns_with_the_rail_that_it_can_have(small_vggt, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    recipe = Path(train.__file__).parents[1] / 'config' / 'train_paper.yaml'
    text = recipe.read_text().replace('n_steps: 250', 'n_steps: 4').replace(
        'rail: null', 'rail: {min_survival: 0.5, max_gap: 5, min_flow: 2.0}').replace(
        'variants: 4', 'variants: 1').replace('steps: 5000000', 'steps: 16')
    Path('own.yaml').write_text(text)
    vggt = ['--backbone', 'vggt', '--weights', str(small_vggt), '--image-width', '70',
            '--stop', '24']
    assert train.main([
        'synthetic:1-2:smooth', '--validation', 'synthetic:3:smooth', '--recipe', 'own.yaml',
        '--environments', '2', *vggt, '--output', 'policy.safetensors']) == 0
    assert 'learned, 16 steps' in capsys.readouterr().out
    policy = read_policy(Path('policy.safetensors'))
    assert policy.guard == KeyframeGuard(0.0, 5, 0.0) and not policy.guard.needs_tracks
    assert (policy.signature.backbone, policy.signature.scale_rule) == ('vggt', 'none')
    assert [name for name, _ in policy.signature.observation] == ['descriptor', 'poses']
    assert run.main(['synthetic:5', '--keyframes', 'learned', '--policy', 'policy.safetensors',
                     '--scale', 'none', '--output', 'out', *vggt]) == 0
    assert policy.training['vggt']['weights'] == str(small_vggt)
    capsys.readouterr()
    assert train.main([
        'synthetic:1-2:smooth', '--validation', 'synthetic:3:smooth', '--recipe', 'own.yaml',
        '--environments', '2', *vggt, '--image-width', '84', '--output', 'policy.safetensors',
        '--resume']) == 1
    assert 'vggt.image_width was 70, now 84' in capsys.readouterr().err


def test_parts_that_are_left_out_are_neither_trained_nor_asked(tmp_path, monkeypatch):
    backbone = GeometricBackbone()
    recipe = replace(read_training_config('train.yaml'), without=('descriptor', 'gap'))
    choices = TrainingSetup(0, recipe, OdometryOptions(), SequenceOptions(), VggtOptions(), None)
    plan = choices.plan(['synthetic:1-4:smooth'], [], backbone)
    assert [name for name, _ in plan.setting.observation][:3] == ['poses', 'track_survival',
                                                                  'flow']
    assert choices.lesson(plan).seen == plan.setting.observation
    everything = choices.plan(['synthetic:1-40:smooth'], [], backbone)
    assert (len(everything.sequences), everything.validation[0]) == (36, 'synthetic:37:smooth')
    assert plan.validation == () and len(plan.sequences) == 4
    whole = replace(recipe, without=())
    present = replace(choices, recipe=whole).plan(['synthetic:1'], [], backbone).setting
    assert len(indices_of(plan.setting.observation, present.observation)) == 49 + 7
