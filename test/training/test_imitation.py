# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""PPO starts from what a teacher would do."""

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

TEACHER = ParallaxRule(flow=12.0, baseline=0.04, survival=0.6)


def choices(**changes) -> TrainingSetup:
    recipe = read_training_config('train.yaml').shortened()
    return TrainingSetup(0, replace(recipe, **{'without': ('descriptor',)} | changes), OdometryOptions(),
                         SequenceOptions(stop=40), VggtOptions(), None)


def test_the_actor_decides_as_its_teacher_did_and_the_critic_knows_what_it_is_worth():
    chosen = choices(reward='paper')
    plan = chosen.plan(['synthetic:1-2:smooth'], [], GeometricBackbone())
    environment = make_environment(chosen.lesson(plan), 2, 1, 0)
    model = make_model(environment, plan.recipe, 0)
    asked = []
    imitation.imitate(model, plan.setting.observation, TEACHER,
                      replace(plan.recipe.imitation, steps=160, passes=40),
                      lambda: asked.append(None))
    assert len(asked) == 160

    seen, kept, returns = imitation._watch(
        model.get_vec_normalize_env(), plan.setting.observation, TEACHER, 160, model.gamma,
        lambda: None)
    with torch.no_grad():
        chances = model.policy.get_distribution(seen).distribution.probs[:, 1]
        values = model.policy.predict_values(seen).flatten()
    assert 0.05 < kept.float().mean() < 0.95
    assert ((chances > 0.5) == kept.bool()).float().mean() > 0.9
    assert 0.02 < chances.min() < 0.35 and 0.65 < chances.max() < 0.98
    assert ((values - returns) ** 2).mean() < 0.25 * (returns ** 2).mean()


def test_what_was_earned_later_counts_less_and_not_beyond_an_episode():
    class Paying(EpisodeVecEnv):
        """Pays 1, 2, 3 ... in episodes of two steps, for a flow that its teacher keeps."""

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
            told = self.reset()
            self.steps = steps
            return told, np.array([steps], dtype=np.float32), np.array([steps % 2 == 0]), [{}]

    layout = (('flow', 1), ('baseline_to_depth', 1), ('track_survival', 1))
    environment = VecNormalize(Paying(), norm_reward=False)
    _, kept, returns = imitation._watch(environment, layout, TEACHER, 5, 0.5, lambda: None)
    assert kept.tolist() == [1] * 5
    assert returns.tolist() == [1 + 0.5 * 2, 2, 3 + 0.5 * 4, 4, 5]


def test_the_teacher_keeps_after_enough_flow_or_baseline_and_when_tracks_are_lost():
    layout = (('poses', 2), ('track_survival', 1), ('baseline_to_depth', 1), ('flow', 1))
    seen = np.array([[9.0, 9.0, 0.9, baseline, np.log1p(flow)]
                     for flow, baseline in ((0.0, 0.0), (11.9, 0.039), (12.1, 0.0), (0.0, 0.041))]
                    + [[0.0, 0.0, 0.59, 0.0, 0.0]])
    assert TEACHER.decide(seen, layout).tolist() == [0, 0, 1, 1, 1]


def test_without_what_the_teacher_looks_at_nobody_can_be_imitated():
    for without, missing in ((('signals',), 'flow and baseline_to_depth and track_survival'),
                             (('track_survival',), 'track_survival')):
        with pytest.raises(KfvoError, match=f'teacher: .* does not observe {missing}$'):
            choices(without=without).plan(['synthetic:1'], [], GeometricBackbone())
    assert choices(without=('signals',), teacher=None).plan(
        ['synthetic:1'], [], GeometricBackbone()).recipe.teacher is None
