# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every number that is chosen for a training, from one YAML file of the config folder."""

from __future__ import annotations

from dataclasses import dataclass, replace

from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import ObservationLayout
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.keyframes.heuristics import ParallaxRule
from kfvo_ros.odometry.scale import SCALE_RULES
from kfvo_ros.training.augmentation import Augmentation
from kfvo_ros.utils.config import from_mapping, option, required
from kfvo_ros.utils.files import find_config, read_yaml

REWARDS = ('local', 'paper')
"""What a decision can be worth in training."""
IMAGE_PARTS, SIGNALS = ('descriptor', 'poses'), 'signals'
"""The parts of an observation that there always are; the others are a backbone's signals."""


@dataclass(frozen=True)
class TrainOptions:
    """How a policy is trained."""

    recipe: str = option('train.yaml', 'every number of the training: a YAML file, or the name '
                         'of one in config/')
    steps: int | None = option(None, "decisions to learn from; default the recipe's", least=1)
    reward: str | None = option(None, "what a decision is worth; default the recipe's", REWARDS)
    environments: int | None = option(
        None, "episodes that are driven side by side; default the recipe's", least=1, most=1000)
    workers: int = option(1, 'processes that drive them', least=1, most=256)
    cache: str | None = option(
        None, 'folder that keeps what the backbone made of the training sequences; default: none '
        'is kept')
    resume: bool = option(False, 'go on from the checkpoint beside --output')
    overwrite: bool = option(False, 'begin anew where there is a policy or a checkpoint')
    smoke: bool = option(False, 'try everything in a minute, on short rendered sequences unless '
                         'others are named')


@dataclass(frozen=True)
class Ppo:
    """What stable-baselines3 calls so; ``batch_size`` None is the whole rollout."""

    n_steps: int = required(least=2)
    batch_size: int | None = required(least=2)
    n_epochs: int = required(least=1)
    gamma: float = required(least=0.0, most=1.0)
    gae_lambda: float = required(least=0.0, most=1.0)
    clip_range: float = required(least=1e-3, most=1.0)
    ent_coef: float = required(least=0.0, most=1.0)
    vf_coef: float = required(least=0.0, most=10.0)
    max_grad_norm: float = required(least=1e-3, most=1e3)
    normalise_reward: bool = required()


@dataclass(frozen=True)
class Imitation:
    """How the teacher is imitated: so many ``steps`` of each environment, in ``passes`` of Adam.

    ``certainty`` is how sure of the teacher's decisions the pupil becomes.
    """

    steps: int = required(least=1)
    passes: int = required(least=1)
    batch_size: int = required(least=1)
    learning_rate: float = required(least=0.0, most=1.0)
    certainty: float = required(least=0.5, most=1.0)


@dataclass(frozen=True)
class LearningRate:
    """Adam's, on a line from the first step to the last."""

    first: float = required(least=0.0, most=1.0)
    last: float = required(least=0.0, most=1.0)

    def at(self, remaining: float) -> float:
        """Return the rate when a share of the steps remains."""
        return self.last + (self.first - self.last) * max(remaining, 0.0)


@dataclass(frozen=True)
class TrainingConfig:
    """A training, after so many ``steps``: decisions in all environments together.

    ``span`` is the local reward's, ``scale`` None the backbone's own rule, ``teacher`` who is
    imitated first, and ``imitation`` how, None for nobody; ``rail`` None is no rail; ``without``
    names parts of the observation that the policy does not see (`excluded_parts`); ``width`` is that of
    the networks.
    """

    steps: int = required(least=1)
    environments: int = required(least=1, most=1000)
    validation_every: int = required(least=1)
    reward: str = required(choices=REWARDS)
    span: int = required(least=40, most=1000)
    alpha: float = required(least=-1.0, most=1.0)
    scale: str | None = required(choices=SCALE_RULES)
    teacher: ParallaxRule | None = required(within={'flow': (0.0, 1e3), 'baseline': (0.0, 1e3),
                                                    'survival': (0.0, 1.0)})
    imitation: Imitation | None = required()
    rail: KeyframeGuard | None = required(within={'min_survival': (0.0, 1.0), 'max_gap': (1, None),
                                                  'min_flow': (0.0, 1e3)})
    without: tuple[str, ...] = required()
    tracks: int = required(least=50, most=2000)
    variants: int = required(least=1, most=1000)
    augmentation: Augmentation = required(within={
        'brightness': (0.0, 1.0), 'contrast': (0.0, 1.0), 'saturation': (0.0, 1.0),
        'calibration': (0.0, 0.1), 'drop_share': (0.0, 0.9), 'max_stride': (1, 20),
        'frames': (20, None)})
    width: int = required(least=1, most=4096)
    ppo: Ppo = required()
    learning_rate: LearningRate = required()

    def shortened(self) -> TrainingConfig:
        """Return the recipe of a test that shows whether everything runs."""
        return replace(self, steps=400, environments=2, validation_every=200,
                       ppo=replace(self.ppo, n_steps=100, n_epochs=2),
                       variants=1, augmentation=replace(self.augmentation, max_stride=1))


def read_training_config(name: str) -> TrainingConfig:
    """Return the recipe of a file, found as `find_config` does; raises KfvoError."""
    path = find_config(name)
    recipe = from_mapping(TrainingConfig, read_yaml(path, 'the recipe '), str(path))
    if recipe.teacher is not None and recipe.imitation is None:
        raise KfvoError(f'{path}: imitation: expected how the teacher is imitated; came None')
    return recipe


def excluded_parts(without: tuple[str, ...], layout: ObservationLayout) -> tuple[str, ...]:
    """Return the names of all parts that are left out of an observation; raises KfvoError.

    In `without` the word ``signals`` stands for all that are neither descriptor nor poses.
    """
    signals = tuple(name for name, _ in layout if name not in IMAGE_PARTS)
    known = (*IMAGE_PARTS, SIGNALS, *signals)
    for name in without:
        if name not in known:
            raise KfvoError(f'without: expected names out of {", ".join(known)}; came {name}')
    named = {*without, *(signals if SIGNALS in without else ())}
    left_out = tuple(name for name, _ in layout if name in named)
    if len(left_out) == len(layout):
        raise KfvoError('without: expected to leave a part of the observation; came '
                        f'{", ".join(without)}')
    return left_out
