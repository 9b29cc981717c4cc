# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From a trained actor to the numbers that run without torch."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from torch import nn

from kfvo_ros.keyframes.learned import Actor, Layer
from kfvo_ros.learning.actor_critic import PrivilegedCritic, TwoNetworks


def export_actor(policy: PrivilegedCritic, seen: RunningMeanStd, epsilon: float) -> Actor:
    """Return the actor with the statistics of what it has `seen`, not standardised, (D,).

    `epsilon` is that of the standardisation in training, on the variance.
    """
    networks = policy.mlp_extractor
    assert isinstance(networks, TwoNetworks)
    steps = [*networks.actor, policy.action_net]
    return Actor(
        np.asarray(seen.mean, dtype=np.float64),
        np.sqrt(np.asarray(seen.var, dtype=np.float64) + epsilon),
        tuple(Layer(step.weight.detach().cpu().numpy().copy(),
                    step.bias.detach().cpu().numpy().copy())
              for step in steps if isinstance(step, nn.Linear)))
