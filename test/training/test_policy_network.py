# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The networks of actor and critic, and the export of the actor."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

import torch
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd

from kfvo_ros.keyframes.learned import CLIP
from kfvo_ros.training.env import OBSERVATION, PRIVILEGED
from kfvo_ros.training.episode import PRIVILEGED_SIZE
from kfvo_ros.training.policy_network import PrivilegedCritic, export_actor

SIZE = 105


@pytest.fixture(scope='module')
def policy() -> PrivilegedCritic:
    torch.manual_seed(0)
    seen = spaces.Dict({
        OBSERVATION: spaces.Box(-np.inf, np.inf, (SIZE,), np.float32),
        PRIVILEGED: spaces.Box(-np.inf, np.inf, (PRIVILEGED_SIZE,), np.float32)})
    made = PrivilegedCritic(seen, spaces.Discrete(2), lambda _: 3e-4, width=256)
    for parameter in made.parameters():  # the last layer begins near zero otherwise
        torch.nn.init.normal_(parameter, std=0.05)
    return made


def observations(count: int) -> dict[str, torch.Tensor]:
    return {OBSERVATION: torch.randn(count, SIZE, requires_grad=True),
            PRIVILEGED: torch.randn(count, PRIVILEGED_SIZE, requires_grad=True)}


def test_the_actor_does_not_see_privileged_input(policy):
    seen = observations(16)
    policy.get_distribution(seen).distribution.logits.abs().sum().backward()
    assert seen[OBSERVATION].grad.abs().sum() > 0.0
    assert seen[PRIVILEGED].grad is None or not seen[PRIVILEGED].grad.any()


def test_the_critic_sees_both(policy):
    seen = observations(16)
    policy.predict_values(seen).sum().backward()
    assert all(seen[name].grad.abs().sum() > 0.0 for name in (OBSERVATION, PRIVILEGED))


def test_actor_and_critic_share_no_parameters(policy):
    actor = {id(each) for part in (policy.mlp_extractor.actor, policy.action_net)
             for each in part.parameters()}
    critic = {id(each) for part in (policy.mlp_extractor.critic, policy.value_net)
              for each in part.parameters()}
    assert not actor & critic
    assert {id(each) for each in policy.parameters()} == actor | critic
    shapes = [tuple(each.shape) for part in (policy.mlp_extractor.actor, policy.action_net)
              for each in part.parameters() if each.dim() == 2]
    assert shapes == [(256, SIZE), (256, 256), (2, 256)]


def test_the_exported_actor_is_the_trained_one(policy):
    random = np.random.default_rng(0)
    seen = RunningMeanStd(shape=(SIZE,))
    seen.update(random.normal(3.0, random.uniform(0.1, 5.0, SIZE), (5000, SIZE)))
    actor = export_actor(policy, seen, 1e-8)
    raw = random.normal(3.0, 10.0, (1000, SIZE)).astype(np.float32)
    standard = np.clip((raw - seen.mean) / np.sqrt(seen.var + 1e-8), -CLIP, CLIP)
    with torch.no_grad():
        expected = policy.get_distribution({
            OBSERVATION: torch.tensor(standard, dtype=torch.float32),
            PRIVILEGED: torch.zeros(1000, PRIVILEGED_SIZE)}).distribution.probs.numpy()
    logits = actor.logits(raw).astype(np.float64)
    preferences = np.exp(logits - logits.max(axis=1, keepdims=True))
    found = preferences / preferences.sum(axis=1, keepdims=True)
    assert np.abs(found - expected).max() < 1e-6
    assert 100 < (found[:, 1] > 0.5).sum() < 900


def test_the_exported_actor_adds_epsilon_to_the_variance(policy):
    """An input that never varied in training has variance 0 and is divided by epsilon's root."""
    statistics = RunningMeanStd(shape=(SIZE,))
    statistics.mean, statistics.var = np.full(SIZE, 3.0), np.full(SIZE, 0.05)
    statistics.var[::2] = 0.0
    actor = export_actor(policy, statistics, 0.04)
    np.testing.assert_allclose(actor.std[:2], [0.2, 0.3], rtol=1e-12)
    standard = np.random.default_rng(1).uniform(-2.0, 2.0, (50, SIZE)).astype(np.float32)
    raw = 3.0 + standard * np.tile([0.2, 0.3], SIZE)[:SIZE]
    with torch.no_grad():
        expected = policy.get_distribution({
            OBSERVATION: torch.tensor(standard),
            PRIVILEGED: torch.zeros(50, PRIVILEGED_SIZE)}).distribution.logits.numpy()
    found = actor.logits(raw)
    # torch normalises its logits; their difference is the same.
    np.testing.assert_allclose(found[:, 1] - found[:, 0], expected[:, 1] - expected[:, 0],
                               atol=1e-5)
