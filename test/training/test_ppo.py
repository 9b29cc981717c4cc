# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trained models: checkpoint and export; and trainings of VGGT."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

import torch
from stable_baselines3.common.running_mean_std import RunningMeanStd

from kfvo_ros import run, train
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
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


@pytest.fixture(scope='module')
def trained():
    """Return a model after a few steps, and its plan."""
    recipe = read_training_config('train.yaml').shortened()
    recipe = replace(recipe, ppo=replace(recipe.ppo, n_steps=32))
    backbone = GeometricBackbone()
    setup = TrainingSetup(0, recipe, OdometryOptions(), SequenceOptions(stop=30), VggtOptions(),
                          None)
    plan = setup.plan(['synthetic:1:smooth'], [], backbone)
    environment = make_environment(setup.environment_config(plan), 2, 1, 0)
    model = make_model(environment, plan.recipe, 0)
    model.learn(128)
    return model, plan


def test_a_checkpoint_restores_everything(trained, tmp_path):
    model, plan = trained
    path = tmp_path / 'checkpoint.pt'
    Checkpoint.of(model, plan, 128, 0.5).write(path)
    read = read_checkpoint(path, plan)
    fresh = make_model(model.get_vec_normalize_env().unwrapped, plan.recipe, 1)
    read.restore(fresh)
    assert fresh.num_timesteps == 128 and read.best == 0.5
    for name, saved in statistics_of(model).items():
        restored = statistics_of(fresh)[name]
        np.testing.assert_array_equal(restored.mean, saved.mean)
        np.testing.assert_array_equal(restored.var, saved.var)
        assert restored.count == saved.count
    stored, restored = model.get_parameters(), fresh.get_parameters()
    for name, tensor in stored['policy'].items():
        assert torch.equal(tensor, restored['policy'][name])
    for number, state in stored['policy.optimizer']['state'].items():
        other = restored['policy.optimizer']['state'][number]
        assert all(torch.equal(value, other[name]) for name, value in state.items())


@pytest.mark.parametrize('change', [
    {'parameters': {}}, {'statistics': {}},
    {'parameters': {'policy': {}, 'policy.optimizer': {}}}, {'parameters': {'__init__': {}}}])
def test_a_checkpoint_that_does_not_fit_is_one_clear_line(trained, change):
    model, plan = trained
    bad = replace(Checkpoint.of(model, plan, 128, 0.5), **change)
    with pytest.raises(KfvoError, match='the checkpoint does not fit') as refusal:
        bad.restore(make_model(model.get_vec_normalize_env().unwrapped, plan.recipe, 1))
    assert '\n' not in str(refusal.value)


def test_the_exported_actor_is_the_trained_one(trained):
    model, _ = trained
    normalise = model.get_vec_normalize_env()
    statistics = normalise.obs_rms[OBSERVATION]
    random = np.random.default_rng(0)
    raw = random.normal(statistics.mean, 4.0 * np.sqrt(statistics.var),
                        (1000, len(statistics.mean))).astype(np.float32)
    standardised = normalise.normalize_obs({OBSERVATION: raw, PRIVILEGED: np.zeros(
        (1000, len(normalise.obs_rms[PRIVILEGED].mean)), np.float32)})
    assert np.abs(standardised[OBSERVATION]).max() == CLIP
    with torch.no_grad():
        expected = model.policy.get_distribution(
            model.policy.obs_to_tensor(standardised)[0]).distribution.logits.numpy()
    logits = export_actor(model.policy, statistics, EPSILON).logits(raw).astype(np.float64)
    found = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
    assert np.abs(found - expected).max() < 1e-6
    assert expected[:, KEEP].std() > 1e-3  # the actor is not constant


def test_the_exported_actor_standardises_a_constant_input_as_in_training(trained):
    model, _ = trained
    normalise = model.get_vec_normalize_env()
    size, privileged_size = (len(normalise.obs_rms[name].mean)
                             for name in (OBSERVATION, PRIVILEGED))
    statistics = RunningMeanStd(shape=(size,))
    statistics.mean, statistics.var = np.full(size, 0.5), np.zeros(size)
    actor = export_actor(model.policy, statistics, EPSILON)
    np.testing.assert_array_equal(actor.std, 1e-4)  # the root of 1e-8
    raw = (0.5 + np.array([[-1e-4], [3e-5], [2e-4]]) * np.ones(size)).astype(np.float32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(normalise.obs_rms, OBSERVATION, statistics)
        expected = normalise.normalize_obs({
            OBSERVATION: raw, PRIVILEGED: np.zeros((3, privileged_size), np.float32)})
    np.testing.assert_allclose((raw - actor.mean) / actor.std, expected[OBSERVATION], rtol=1e-6)


def test_vggt_is_trained_with_the_gap_of_the_guard_only(small_vggt, tmp_path, monkeypatch, capsys):
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
