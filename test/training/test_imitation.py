# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Behaviour cloning of an expert before PPO."""

from __future__ import annotations

from dataclasses import replace

import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.heuristics import ParallaxRule
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.training import imitation
from kfvo_ros.training.config import read_training_config
from kfvo_ros.training.env import OBSERVATION, PRIVILEGED, EpisodeVecEnv
from kfvo_ros.training.plan import TrainingSetup
from kfvo_ros.training.ppo import make_model
from kfvo_ros.training.sampler import make_environment

EXPERT = ParallaxRule(flow=12.0, baseline=0.04, survival=0.6)


def make_setup(**changes) -> TrainingSetup:
    recipe = read_training_config('train.yaml').shortened()
    recipe = replace(recipe, **{'without': ('descriptor',)} | changes)
    return TrainingSetup(0, recipe, OdometryOptions(), SequenceOptions(stop=40), VggtOptions(),
                         None)


def test_the_actor_learns_the_expert_s_decisions_and_the_critic_their_returns():
    setup = make_setup(reward='paper')
    plan = setup.plan(['synthetic:1-2:smooth'], [], GeometricBackbone())
    environment = make_environment(setup.environment_config(plan), 2, 1, 0)
    model = make_model(environment, plan.recipe, 0)
    steps = []
    imitation.imitate(model, plan.signature.observation, EXPERT,
                      replace(plan.recipe.imitation, steps=160, passes=40),
                      lambda: steps.append(None))
    assert len(steps) == 160

    observations, actions, returns = imitation._demonstrate(
        model.get_vec_normalize_env(), plan.signature.observation, EXPERT, 160, model.gamma,
        lambda: None)
    with torch.no_grad():
        keep = model.policy.get_distribution(observations).distribution.probs[:, 1]
        values = model.policy.predict_values(observations).flatten()
    assert 0.05 < actions.float().mean() < 0.95
    assert ((keep > 0.5) == actions.bool()).float().mean() > 0.9
    assert 0.02 < keep.min() < 0.35 and 0.65 < keep.max() < 0.98
    assert ((values - returns) ** 2).mean() < 0.25 * (returns ** 2).mean()


def test_returns_are_discounted_and_end_with_the_episode():
    class PayingEnvironment(EpisodeVecEnv):
        """Rewards 1, 2, 3 ... in episodes of two steps, with a flow that the expert keeps."""

        def __init__(self) -> None:
            super().__init__(1, spaces.Dict({
                OBSERVATION: spaces.Box(-np.inf, np.inf, (3,), np.float32),
                PRIVILEGED: spaces.Box(-np.inf, np.inf, (1,), np.float32)}), spaces.Discrete(2))

        def reset(self):
            self.steps = 0
            return {OBSERVATION: np.array([[np.log1p(13.0), 0.0, 1.0]], dtype=np.float32),
                    PRIVILEGED: np.zeros((1, 1), dtype=np.float32)}

        def step_async(self, actions):
            assert actions.tolist() == [1]

        def step_wait(self):
            steps = self.steps + 1
            observations = self.reset()
            self.steps = steps
            rewards, dones = np.array([steps], dtype=np.float32), np.array([steps % 2 == 0])
            return observations, rewards, dones, [{}]

    layout = (('flow', 1), ('baseline_to_depth', 1), ('track_survival', 1))
    environment = VecNormalize(PayingEnvironment(), norm_reward=False)
    _, actions, returns = imitation._demonstrate(environment, layout, EXPERT, 5, 0.5,
                                                 lambda: None)
    assert actions.tolist() == [1] * 5
    assert returns.tolist() == [1 + 0.5 * 2, 2, 3 + 0.5 * 4, 4, 5]


def test_the_expert_keeps_after_enough_flow_or_baseline_and_when_tracks_are_lost():
    layout = (('poses', 2), ('track_survival', 1), ('baseline_to_depth', 1), ('flow', 1))
    seen = np.array([[9.0, 9.0, 0.9, baseline, np.log1p(flow)]
                     for flow, baseline in ((0.0, 0.0), (11.9, 0.039), (12.1, 0.0), (0.0, 0.041))]
                    + [[0.0, 0.0, 0.59, 0.0, 0.0]])
    assert EXPERT.decide(seen, layout).tolist() == [0, 0, 1, 1, 1]


def test_an_expert_whose_signals_are_not_observed_is_refused():
    for without, missing in ((('signals',), 'flow and baseline_to_depth and track_survival'),
                             (('track_survival',), 'track_survival')):
        with pytest.raises(KfvoError, match=f'teacher: .* does not observe {missing}$'):
            make_setup(without=without).plan(['synthetic:1'], [], GeometricBackbone())
    assert make_setup(without=('signals',), expert=None).plan(
        ['synthetic:1'], [], GeometricBackbone()).recipe.expert is None
