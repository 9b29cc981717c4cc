# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every number that is chosen for a training, from one YAML file of the config folder."""

from __future__ import annotations

from dataclasses import dataclass, replace

from kfvo_ros.config_files import find_config
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.observation import Layout
from kfvo_ros.keyframes.rail import Rail
from kfvo_ros.learning.augmentation import Augmentation
from kfvo_ros.learning.strict import from_mapping, key
from kfvo_ros.learning.teacher import Teacher
from kfvo_ros.options import REWARDS
from kfvo_ros.scale import SCALE_RULES
from kfvo_ros.yaml_file import read_yaml

IMAGE_PARTS, SIGNALS = ('descriptor', 'poses'), 'signals'
"""The parts of an observation that there always are; the others are a backbone's signals."""


@dataclass(frozen=True)
class Ppo:
    """What stable-baselines3 calls so; ``batch_size`` None is the whole rollout."""

    n_steps: int = key(least=2)
    batch_size: int | None = key(least=2)
    n_epochs: int = key(least=1)
    gamma: float = key(least=0.0, most=1.0)
    gae_lambda: float = key(least=0.0, most=1.0)
    clip_range: float = key(least=1e-3, most=1.0)
    ent_coef: float = key(least=0.0, most=1.0)
    vf_coef: float = key(least=0.0, most=10.0)
    max_grad_norm: float = key(least=1e-3, most=1e3)
    normalise_reward: bool = key()


@dataclass(frozen=True)
class Imitation:
    """How the teacher is imitated: so many ``steps`` of each environment, in ``passes`` of Adam.

    ``certainty`` is how sure of the teacher's decisions the pupil becomes.
    """

    steps: int = key(least=1)
    passes: int = key(least=1)
    batch_size: int = key(least=1)
    learning_rate: float = key(least=0.0, most=1.0)
    certainty: float = key(least=0.5, most=1.0)


@dataclass(frozen=True)
class LearningRate:
    """Adam's, on a line from the first step to the last."""

    first: float = key(least=0.0, most=1.0)
    last: float = key(least=0.0, most=1.0)

    def at(self, remaining: float) -> float:
        """Return the rate when a share of the steps remains."""
        return self.last + (self.first - self.last) * max(remaining, 0.0)


@dataclass(frozen=True)
class Recipe:
    """A training, after so many ``steps``: decisions in all environments together.

    ``span`` is the local reward's, ``scale`` None the backbone's own rule, ``teacher`` who is
    imitated first, and ``imitation`` how, None for nobody; ``rail`` None is no rail; ``without``
    names parts of the observation that the policy does not see (`unseen`); ``width`` is that of
    the networks.
    """

    steps: int = key(least=1)
    environments: int = key(least=1, most=1000)
    validation_every: int = key(least=1)
    reward: str = key(choices=REWARDS)
    span: int = key(least=40, most=1000)
    alpha: float = key(least=-1.0, most=1.0)
    scale: str | None = key(choices=SCALE_RULES)
    teacher: Teacher | None = key(within={'flow': (0.0, 1e3), 'baseline': (0.0, 1e3),
                                          'survival': (0.0, 1.0)})
    imitation: Imitation | None = key()
    rail: Rail | None = key(within={'min_survival': (0.0, 1.0), 'max_gap': (1, None),
                                    'min_flow': (0.0, 1e3)})
    without: tuple[str, ...] = key()
    tracks: int = key(least=50, most=2000)
    variants: int = key(least=1, most=1000)
    augmentation: Augmentation = key(within={
        'brightness': (0.0, 1.0), 'contrast': (0.0, 1.0), 'saturation': (0.0, 1.0),
        'calibration': (0.0, 0.1), 'drop_share': (0.0, 0.9), 'max_stride': (1, 20),
        'frames': (20, None)})
    width: int = key(least=1, most=4096)
    ppo: Ppo = key()
    learning_rate: LearningRate = key()

    def shortened(self) -> Recipe:
        """Return the recipe of a test that shows whether everything runs."""
        return replace(self, steps=400, environments=2, validation_every=200,
                       ppo=replace(self.ppo, n_steps=100, n_epochs=2),
                       variants=1, augmentation=replace(self.augmentation, max_stride=1))


def read_recipe(name: str) -> Recipe:
    """Return the recipe of a file, found as `find_config` does; raises KfvoError."""
    path = find_config(name)
    recipe = from_mapping(Recipe, read_yaml(path, 'the recipe '), str(path))
    if recipe.teacher is not None and recipe.imitation is None:
        raise KfvoError(f'{path}: imitation: expected how the teacher is imitated; came None')
    return recipe


def unseen(without: tuple[str, ...], layout: Layout) -> tuple[str, ...]:
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
