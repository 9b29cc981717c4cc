# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recipe of a training: every number of it, from one YAML file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import ObservationLayout
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.keyframes.heuristics import ParallaxRule
from kfvo_ros.odometry.scale import SCALE_RULES
from kfvo_ros.training.augmentation import Augmentation
from kfvo_ros.utils.config import from_mapping, option, required
from kfvo_ros.utils.files import find_config, read_yaml

REWARDS = ('local', 'paper')
COMMON_PARTS, SIGNALS = ('descriptor', 'poses'), 'signals'
"""Parts of the observation with every backbone; the others are the backbone's signals."""


@dataclass(frozen=True)
class TrainOptions:
    """How a policy is trained."""

    recipe: str = option('train.yaml', 'every number of the training: a YAML file, or the name '
                         'of one in config/')
    steps: int | None = option(None, "decisions to learn from; default the recipe's", least=1)
    reward: str | None = option(None, "reward of a decision; default the recipe's", REWARDS)
    environments: int | None = option(
        None, "episodes that are stepped side by side; default the recipe's", least=1, most=1000)
    workers: int = option(1, 'processes that step them', least=1, most=256)
    cache: str | None = option(
        None, 'folder for the encoded training sequences; default: they are not stored')
    resume: bool = option(False, 'go on from the checkpoint beside --output')
    overwrite: bool = option(False, 'replace an earlier policy and checkpoint')
    smoke: bool = option(False, 'test everything in a minute, on short rendered sequences unless '
                         'others are named')


@dataclass(frozen=True)
class PpoConfig:
    """Parameters of PPO as stable-baselines3 names them; ``batch_size`` None is the rollout."""

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
    """Behaviour cloning: ``steps`` of each environment, learned in ``passes`` of Adam.

    ``certainty`` is the target probability of the expert's decisions.
    """

    steps: int = required(least=1)
    passes: int = required(least=1)
    batch_size: int = required(least=1)
    learning_rate: float = required(least=0.0, most=1.0)
    certainty: float = required(least=0.5, most=1.0)


@dataclass(frozen=True)
class LinearSchedule:
    """Learning rate of Adam, linear from the ``first`` step to the ``last``."""

    first: float = required(least=0.0, most=1.0)
    last: float = required(least=0.0, most=1.0)

    def __call__(self, progress_remaining: float) -> float:
        """Return the rate; stable-baselines3 counts progress from 1 to 0, or a bit below."""
        return self.last + (self.first - self.last) * max(progress_remaining, 0.0)


@dataclass(frozen=True)
class TrainingConfig:
    """The recipe of a training of ``steps`` decisions in all environments together.

    ``span`` is that of the local reward; ``scale`` None is the backbone's default rule; PPO
    starts from the ``expert``, None for a random start, by ``imitation``; ``guard`` None forces
    no decision; ``without`` names the parts of the observation that the policy does not see
    (`excluded_parts`); ``width`` is that of the hidden layers.
    """

    steps: int = required(least=1)
    environments: int = required(least=1, most=1000)
    validation_every: int = required(least=1)
    reward: str = required(choices=REWARDS)
    span: int = required(least=40, most=1000)
    alpha: float = required(least=-1.0, most=1.0)
    scale: str | None = required(choices=SCALE_RULES)
    expert: ParallaxRule | None = required(key='teacher', within={
        'flow': (0.0, 1e3), 'baseline': (0.0, 1e3), 'survival': (0.0, 1.0)})
    imitation: Imitation | None = required()
    guard: KeyframeGuard | None = required(key='rail', within={
        'min_survival': (0.0, 1.0), 'max_gap': (1, None), 'min_flow': (0.0, 1e3)})
    without: tuple[str, ...] = required()
    tracks: int = required(least=50, most=2000)
    variants: int = required(least=1, most=1000)
    augmentation: Augmentation = required(within={
        'brightness': (0.0, 1.0), 'contrast': (0.0, 1.0), 'saturation': (0.0, 1.0),
        'calibration': (0.0, 0.1), 'drop_share': (0.0, 0.9), 'max_stride': (1, 20),
        'frames': (20, None)})
    width: int = required(least=1, most=4096)
    ppo: PpoConfig = required()
    learning_rate: LinearSchedule = required()

    def shortened(self) -> TrainingConfig:
        """Return the recipe of a smoke test."""
        return replace(self, steps=400, environments=2, validation_every=200,
                       ppo=replace(self.ppo, n_steps=100, n_epochs=2),
                       variants=1, augmentation=replace(self.augmentation, max_stride=1))


def read_training_config(name: str) -> TrainingConfig:
    """Read the recipe from a file, found as `find_config` does; raises KfvoError."""
    path = find_config(name)
    return make_training_config(read_yaml(path, 'the recipe '), path)


def make_training_config(mapping: Any, path: Path, place: str = '') -> TrainingConfig:
    """Build the recipe from the content of a file, or of a `place` in it; raises KfvoError."""
    recipe = from_mapping(TrainingConfig, mapping, str(path), place)
    if recipe.expert is not None and recipe.imitation is None:
        key = f'{place}.imitation'.lstrip('.')
        raise KfvoError(f'{path}: {key}: expected how the teacher is imitated; came None')
    return recipe


def excluded_parts(without: tuple[str, ...], layout: ObservationLayout) -> tuple[str, ...]:
    """Return the names of all parts that are excluded from an observation; raises KfvoError.

    In `without` the word ``signals`` stands for all parts but descriptor and poses.
    """
    signals = tuple(name for name, _ in layout if name not in COMMON_PARTS)
    known = (*COMMON_PARTS, SIGNALS, *signals)
    for name in without:
        if name not in known:
            raise KfvoError(f'without: expected names out of {", ".join(known)}; came {name}')
    named = {*without, *(signals if SIGNALS in without else ())}
    excluded = tuple(name for name, _ in layout if name in named)
    if len(excluded) == len(layout):
        raise KfvoError('without: expected to leave a part of the observation; came '
                        f'{", ".join(without)}')
    return excluded
