# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Actor and critic networks without shared layers; only the critic sees privileged input."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from kfvo_ros.keyframes.learned import Actor, Layer
from kfvo_ros.training.env import OBSERVATION, PRIVILEGED

INPUTS = (OBSERVATION, PRIVILEGED)
"""Inputs of the critic, in the order of its features; the actor has the first only."""


class ConcatenatedInputs(BaseFeaturesExtractor):
    """Concatenates observation and privileged observation."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        super().__init__(observation_space, sum(_sizes(observation_space)))

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Return features (B, observation size + privileged size)."""
        return torch.cat([observations[name] for name in INPUTS], dim=1)


class ActorAndCritic(nn.Module):
    """Hidden layers of actor and critic: two of `width` each; the heads belong to the policy."""

    def __init__(self, observation_size: int, privileged_size: int, width: int) -> None:
        super().__init__()
        self.observation_size = observation_size
        self.latent_dim_pi = self.latent_dim_vf = width
        self.actor = _hidden_layers(observation_size, width)
        self.critic = _hidden_layers(observation_size + privileged_size, width)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the latent features of actor and critic, (B, width) each."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: Tensor) -> Tensor:
        """Return the actor's latent features (B, width); it reads the observation only."""
        return self.actor(features[:, :self.observation_size])

    def forward_critic(self, features: Tensor) -> Tensor:
        """Return the critic's latent features (B, width)."""
        return self.critic(features)


class PrivilegedCritic(ActorCriticPolicy):
    """Asymmetric actor-critic policy (paper, sections IV-C and IV-E).

    Use: ``PPO(PrivilegedCritic, environment, policy_kwargs={'width': 256})``.
    """

    def __init__(self, *arguments: Any, width: int, **options: Any) -> None:
        self._width = width
        super().__init__(*arguments, **options | {'features_extractor_class': ConcatenatedInputs})

    def _build_mlp_extractor(self) -> None:
        assert isinstance(self.observation_space, spaces.Dict)
        observation_size, privileged_size = _sizes(self.observation_space)
        self.mlp_extractor = ActorAndCritic(  # type: ignore[assignment]
            observation_size, privileged_size, self._width)


def export_actor(policy: PrivilegedCritic, statistics: RunningMeanStd, epsilon: float) -> Actor:
    """Return the actor with the running `statistics` (D,) of its raw observations.

    `epsilon` is what VecNormalize adds to the variance in training.
    """
    networks = policy.mlp_extractor
    assert isinstance(networks, ActorAndCritic)
    modules = [*networks.actor, policy.action_net]
    return Actor(
        np.asarray(statistics.mean, dtype=np.float64),
        np.sqrt(np.asarray(statistics.var, dtype=np.float64) + epsilon),
        tuple(Layer(module.weight.detach().cpu().numpy().copy(),
                    module.bias.detach().cpu().numpy().copy())
              for module in modules if isinstance(module, nn.Linear)))


def _sizes(space: spaces.Dict) -> list[int]:
    """Return the sizes of observation and privileged observation."""
    return [spaces.flatdim(space[name]) for name in INPUTS]


def _hidden_layers(size: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(size, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
