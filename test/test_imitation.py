# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""PPO starts from what a teacher would do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

import torch

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.learning import imitation
from kfvo_ros.learning.environment import OBSERVATION
from kfvo_ros.learning.plan import Choices
from kfvo_ros.learning.recipe import read_recipe
from kfvo_ros.learning.school import make_environment
from kfvo_ros.learning.training import make_model
from kfvo_ros.options import OdometryOptions, SequenceOptions, VggtOptions

SHARE = 0.85


def choices(**changes) -> Choices:
    recipe = read_recipe('train.yaml').shortened()
    return Choices(0, replace(recipe, **{'without': ('descriptor',)} | changes), OdometryOptions(),
                   SequenceOptions(stop=40), VggtOptions(), None)


def test_the_actor_decides_as_its_teacher_did_and_the_critic_knows_what_it_is_worth(monkeypatch):
    monkeypatch.setattr(imitation, 'STEPS', 160)
    monkeypatch.setattr(imitation, 'PASSES', 40)
    chosen = choices(reward='paper')
    plan = chosen.plan(['synthetic:1-2:smooth'], [], GeometricBackbone())
    environment = make_environment(chosen.lesson(plan), 2, 1, 0)
    model = make_model(environment, plan.recipe, 0)
    asked = []
    imitation.imitate(model, plan.setting.observation, SHARE, lambda: asked.append(None))
    assert len(asked) == 160

    vector = model.get_vec_normalize_env()
    agreed, kept, worth, told = [], [], [], []
    vector.reset()
    for _ in range(40):
        raw = vector.get_original_obs()
        teacher = raw[OBSERVATION][:, 49] < SHARE  # behind the poses
        seen = {name: torch.as_tensor(values) for name, values in
                vector.normalize_obs(raw).items()}
        with torch.no_grad():
            chance = model.policy.get_distribution(seen).distribution.probs[:, 1].numpy()
            told.append(model.policy.predict_values(seen).numpy().ravel())
        agreed.append((chance > 0.5) == teacher)
        kept.append(teacher)
        worth.append(chance)
        vector.step(teacher.astype(int))
    assert 0.05 < np.mean(kept) < 0.95 and np.mean(agreed) > 0.9
    assert 0.02 < np.min(worth) < 0.35 and 0.65 < np.max(worth) < 0.98
    assert np.isfinite(told).all() and np.std(told) > 0.0


def test_without_what_the_teacher_looks_at_nobody_can_be_imitated():
    for without in (('signals',), ('track_survival',)):
        with pytest.raises(KfvoError, match='teacher: expected null where track_survival'):
            choices(without=without).plan(['synthetic:1'], [], GeometricBackbone())
    assert choices(without=('signals',), teacher=None).plan(
        ['synthetic:1'], [], GeometricBackbone()).recipe.teacher is None
