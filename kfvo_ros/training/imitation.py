# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A start for PPO: the decisions of a teacher, and what they are worth.

From nothing a policy keeps every second frame by chance. That is far from any good policy, and
what a single decision changes there is lost in the noise of all the others.
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


def imitate(model: PPO, layout: ObservationLayout, teacher: ParallaxRule, how: Imitation,
            before_each: Callable[[], None] = lambda: None) -> None:
    """Teach the actor to decide as the teacher does, and the critic what that is worth.

    `layout` is that of the model's observation; the caller has a say `before_each` step.
    """
    environment, policy = model.get_vec_normalize_env(), model.policy
    assert isinstance(environment, VecNormalize) and isinstance(policy, PrivilegedCritic)
    seen, kept, returns = _watch(environment, layout, teacher, how.steps, model.gamma,
                                 before_each)
    optimiser = torch.optim.Adam(policy.parameters(), how.learning_rate)
    rng = torch.Generator().manual_seed(model.seed or 0)
    for _ in range(how.passes):
        for rows in torch.randperm(len(kept), generator=rng).split(how.batch_size):
            batch = {name: values[rows] for name, values in seen.items()}
            values, right, _ = policy.evaluate_actions(batch, kept[rows])
            wrong = torch.log1p(-right.exp().clamp(max=1.0 - 1e-6))
            loss = (0.5 * mse_loss(values.flatten(), returns[rows])
                    - (how.certainty * right + (1.0 - how.certainty) * wrong).mean())
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()


def _watch(environment: VecNormalize, layout: ObservationLayout, teacher: ParallaxRule, steps: int, gamma: float,
           before_each: Callable[[], None]) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Return what the teacher saw, standardised, did, and earned from then on, discounted.

    What would be earned after the end of an episode, or of the steps, is not known: nothing.
    """
    environment.reset()
    seen: list[Observations] = []
    kept, rewards, dones = [], [], []
    for _ in range(steps):
        before_each()
        told = environment.get_original_obs()
        assert isinstance(told, dict)
        seen.append({name: values.copy() for name, values in told.items()})
        kept.append(teacher.decide(told[OBSERVATION], layout))
        _, _, done, _ = environment.step(kept[-1])
        rewards.append(environment.get_original_reward())
        dones.append(done)
    returns, later = [], np.zeros(environment.num_envs)
    for reward, done in zip(reversed(rewards), reversed(dones)):
        later = environment.normalize_reward(reward) + gamma * later * ~done
        returns.append(later)
    standardised = environment.normalize_obs(
        {name: np.concatenate([each[name] for each in seen]) for name in seen[0]})
    assert isinstance(standardised, dict)
    return ({name: torch.as_tensor(values) for name, values in standardised.items()},
            torch.as_tensor(np.concatenate(kept)),
            torch.as_tensor(np.concatenate(returns[::-1]), dtype=torch.float32))
