# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The plan of a training: its sequences, and the observation that the policy sees."""

from __future__ import annotations

from dataclasses import replace

import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.keyframes.base import indices_of
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.training.config import read_training_config
from kfvo_ros.training.plan import TrainingPlan, TrainingSetup


def make_plan(*sequences: str, validation: tuple[str, ...] = (),
              without: tuple[str, ...] = ('descriptor', 'gap')) -> TrainingPlan:
    recipe = replace(read_training_config('train.yaml'), without=without)
    setup = TrainingSetup(0, recipe, OdometryOptions(), SequenceOptions(), VggtOptions(), None)
    plan = setup.plan(sequences, validation, GeometricBackbone())
    assert setup.environment_config(plan).observation == plan.signature.observation
    return plan


def test_excluded_parts_are_not_observed():
    observation = make_plan('synthetic:1').signature.observation
    assert [name for name, _ in observation][:3] == ['poses', 'track_survival', 'flow']
    everything = make_plan('synthetic:1', without=()).signature.observation
    assert len(indices_of(observation, everything)) == 49 + 7


@pytest.mark.parametrize(('text', 'training', 'validation'), [
    ('synthetic:1-4:smooth', 4, ()), ('synthetic:1-5:smooth', 4, ('synthetic:5:smooth',)),
    ('synthetic:1-40:smooth', 36, tuple(f'synthetic:{seed}:smooth' for seed in range(37, 41)))])
def test_of_five_sequences_or_more_a_tenth_is_for_validation(text, training, validation):
    plan = make_plan(text)
    assert len(plan.sequences) == training and plan.validation == validation
    named = make_plan(text, validation=('synthetic:99',))
    assert len(named.sequences) == training + len(validation)
    assert named.validation == ('synthetic:99',)
