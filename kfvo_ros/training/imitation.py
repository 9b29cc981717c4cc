# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Behaviour cloning of an expert as the start of PPO.

An untrained policy keeps half of the frames at random. It is far from any good policy, and the
effect of a single decision is lost in the noise of all others.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor
from torch.nn.functional import mse_loss

from kfvo_ros.keyframes.base import ObservationLayout
from kfvo_ros.keyframes.heuristics import ParallaxRule
from kfvo_ros.training.config import Imitation
from kfvo_ros.training.env import OBSERVATION, Observations
from kfvo_ros.training.policy_network import PrivilegedCritic


def imitate(model: PPO, layout: ObservationLayout, expert: ParallaxRule, config: Imitation,
            before_step: Callable[[], None] = lambda: None) -> None:
    """Train the actor on the expert's decisions, and the critic on their returns.

    `layout` is that of the model's observation; `before_step` is called before each step of the
    environment.
    """
    environment, policy = model.get_vec_normalize_env(), model.policy
    assert isinstance(environment, VecNormalize) and isinstance(policy, PrivilegedCritic)
    observations, actions, returns = _demonstrate(environment, layout, expert, config.steps,
                                                  model.gamma, before_step)
    optimiser = torch.optim.Adam(policy.parameters(), config.learning_rate)
    rng = torch.Generator().manual_seed(model.seed or 0)
    for _ in range(config.passes):
        for rows in torch.randperm(len(actions), generator=rng).split(config.batch_size):
            batch = {name: numbers[rows] for name, numbers in observations.items()}
            values, log_prob, _ = policy.evaluate_actions(batch, actions[rows])
            log_prob_of_other = torch.log1p(-log_prob.exp().clamp(max=1.0 - 1e-6))
            loss = (0.5 * mse_loss(values.flatten(), returns[rows])
                    - (config.certainty * log_prob
                       + (1.0 - config.certainty) * log_prob_of_other).mean())
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()


def _demonstrate(environment: VecNormalize, layout: ObservationLayout, expert: ParallaxRule,
                 steps: int, gamma: float, before_step: Callable[[], None]
                 ) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Return standardised observations, the expert's actions, and discounted returns.

    Rewards after the end of an episode, or after the last step, count as zero.
    """
    environment.reset()
    observations: list[Observations] = []
    actions, rewards, dones = [], [], []
    for _ in range(steps):
        before_step()
        raw = environment.get_original_obs()
        assert isinstance(raw, dict)
        observations.append({name: numbers.copy() for name, numbers in raw.items()})
        actions.append(expert.decide(raw[OBSERVATION], layout))
        _, _, done, _ = environment.step(actions[-1])
        rewards.append(environment.get_original_reward())
        dones.append(done)
    returns, later = [], np.zeros(environment.num_envs)
    for reward, done in zip(reversed(rewards), reversed(dones)):
        later = environment.normalize_reward(reward) + gamma * later * ~done
        returns.append(later)
    standardised = environment.normalize_obs(
        {name: np.concatenate([each[name] for each in observations]) for name in observations[0]})
    assert isinstance(standardised, dict)
    return ({name: torch.as_tensor(numbers) for name, numbers in standardised.items()},
            torch.as_tensor(np.concatenate(actions)),
            torch.as_tensor(np.concatenate(returns[::-1]), dtype=torch.float32))
