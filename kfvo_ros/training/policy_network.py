# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Actor and critic as two networks that share nothing; the critic alone sees the truth."""

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


class ConcatenatedInputs(BaseFeaturesExtractor):
    """The observation, and behind it what is privileged, as they are."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        super().__init__(observation_space, sum(_sizes(observation_space)))

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Return (B, both sizes)."""
        return torch.cat([observations[OBSERVATION], observations[PRIVILEGED]], dim=1)


class ActorAndCritic(nn.Module):
    """Two ReLU networks of two layers each; the last layer of either is the policy's own."""

    def __init__(self, observed: int, privileged: int, width: int) -> None:
        super().__init__()
        self.observed = observed
        self.latent_dim_pi = self.latent_dim_vf = width
        self.actor = _layers(observed, width)
        self.critic = _layers(observed + privileged, width)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the last hidden layers of both, (B, width)."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: Tensor) -> Tensor:
        """Return the actor's last hidden layer; it reads the observation only."""
        return self.actor(features[:, :self.observed])

    def forward_critic(self, features: Tensor) -> Tensor:
        """Return the critic's last hidden layer."""
        return self.critic(features)


class PrivilegedCritic(ActorCriticPolicy):
    """For `PPO(PrivilegedCritic, environment, policy_kwargs={'width': 256})`.

    Source: the paper, sections IV-C and IV-E.
    """

    def __init__(self, *arguments: Any, width: int, **options: Any) -> None:
        self._width = width
        super().__init__(*arguments, **options | {'features_extractor_class': ConcatenatedInputs})

    def _build_mlp_extractor(self) -> None:
        assert isinstance(self.observation_space, spaces.Dict)
        observed, privileged = _sizes(self.observation_space)
        self.mlp_extractor = ActorAndCritic(observed, privileged, self._width)  # type: ignore[assignment]


def _sizes(space: spaces.Dict) -> list[int]:
    """Return how many numbers are observed, and how many privileged."""
    return [spaces.flatdim(space[name]) for name in (OBSERVATION, PRIVILEGED)]


def _layers(size: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(size, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())


def export_actor(policy: PrivilegedCritic, seen: RunningMeanStd, epsilon: float) -> Actor:
    """Return the actor with the statistics of what it has `seen`, not standardised, (D,).

    `epsilon` is that of the standardisation in training, on the variance.
    """
    networks = policy.mlp_extractor
    assert isinstance(networks, ActorAndCritic)
    steps = [*networks.actor, policy.action_net]
    return Actor(
        np.asarray(seen.mean, dtype=np.float64),
        np.sqrt(np.asarray(seen.var, dtype=np.float64) + epsilon),
        tuple(Layer(step.weight.detach().cpu().numpy().copy(),
                    step.bias.detach().cpu().numpy().copy())
              for step in steps if isinstance(step, nn.Linear)))
