# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The trainings of an ablation and the test of their policies."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.evaluation import metrics
from kfvo_ros.keyframes.base import KeyframePolicy
from kfvo_ros.keyframes.guard import NO_GUARD
from kfvo_ros.keyframes.learned import read_policy
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.training.ablation_report import PolicyResult
from kfvo_ros.training.checkpoint import differences, read_checkpoint
from kfvo_ros.training.config import (
    TrainingConfig,
    make_training_config,
    read_training_config,
)
from kfvo_ros.training.evaluation import (
    GuardOnly,
    PolicyEvaluation,
    RandomPolicy,
    ate_percent,
    reference_policies,
)
from kfvo_ros.training.plan import SUFFIX, TrainingFiles, TrainingPlan, TrainingSetup
from kfvo_ros.utils.config import to_mapping
from kfvo_ros.utils.files import atomic_write, find_config, read_yaml
from kfvo_ros.utils.progress import progress

ROWS_FILE = 'ablation.yaml'
MIN_VALIDATIONS = 8
"""Points of a learning curve, at least."""
RANDOM_SEEDS = (0, 1, 2)
"""Seeds of the random policy."""


def make_setup(recipe: str, stop: int | None, cache: Path) -> TrainingSetup:
    """Return what the test and all trainings have in common; raises KfvoError."""
    config = read_training_config(recipe)
    odometry = OdometryOptions(scale_rule=config.scale)
    return TrainingSetup(odometry.seed, config, odometry, SequenceOptions(stop=stop),
                         VggtOptions(), cache)


def read_ablation_rows(recipe: TrainingConfig, steps: int) -> dict[str, TrainingConfig]:
    """Read the rows of ROWS_FILE: the recipe with this many steps, as each row changes it.

    Raises KfvoError for a key or a value that a recipe cannot have.
    """
    path = find_config(ROWS_FILE)
    rows = read_yaml(path, 'the rows ')
    if not isinstance(rows, dict) or not all(isinstance(name, str) for name in rows):
        raise KfvoError(f'{path}: expected rows with the keys that they change; came {rows!r}')
    every = min(recipe.validation_every, max(steps // MIN_VALIDATIONS, 1))
    base = to_mapping(replace(recipe, steps=steps, validation_every=every))
    return {name: make_training_config(_merge(base, changes), path, name)
            for name, changes in rows.items()}


def _merge(base: Any, changes: Any) -> Any:
    """Return a tree of mappings with some of its values changed."""
    if not (isinstance(base, dict) and isinstance(changes, dict)):
        return changes
    return base | {key: _merge(base.get(key), value) for key, value in changes.items()}


@dataclass(frozen=True)
class TrainingRun:
    """The training of a ``row`` with one seed; all runs share a ``folder``."""

    row: str
    plan: TrainingPlan
    folder: Path

    @property
    def seed(self) -> int:
        """The seed of the training."""
        return self.plan.seed

    @property
    def files(self) -> TrainingFiles:
        """The files of the training."""
        return TrainingFiles(str(self.folder / f'{self.row}-{self.seed}{SUFFIX}'))

    @property
    def recipe_file(self) -> Path:
        """The file of the recipe, which all seeds of a row share."""
        return self.folder / f'{self.row}.yaml'

    def prepare(self, resume: bool) -> None:
        """Make the folder; KfvoError for an earlier training that is not this one to `resume`."""
        existing = [path for path in (self.files.output, self.files.folder) if path.exists()]
        if existing and not resume:
            raise KfvoError(f'{existing[0]} is there already; choose another --output, or add '
                            '--resume to go on')
        if not self.is_complete():
            if self.files.checkpoint.exists():
                read_checkpoint(self.files.checkpoint, self.plan)
            elif self.files.output.exists():
                raise KfvoError(f'{self.files.output} is of another training, or has lost its '
                                'checkpoint; choose another --output, or remove it')
        with _writing_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)

    def write_recipe(self) -> None:
        """Write the recipe file; raises KfvoError."""
        with _writing_errors(self.folder), atomic_write(self.recipe_file) as draft:
            draft.write_text(yaml.safe_dump(to_mapping(self.plan.recipe), sort_keys=False),
                             encoding='utf-8')

    def is_complete(self) -> bool:
        """Whether the files are of this training and its last step; raises KfvoError."""
        if not (self.files.output.exists() and self.files.last.exists()):
            return False
        wanted = json.loads(json.dumps(to_mapping(self.plan)))
        stored = read_policy(self.files.last).training
        return (stored.get('steps', 0) >= self.plan.recipe.steps
                and not any(differences({key: value for key, value in stored.items()
                                         if key in wanted}, wanted)))


@dataclass(frozen=True)
class PolicyTest:
    """Tests policies on the ``sequences`` of an evaluation, by the names on the command line."""

    sequences: tuple[str, ...]
    evaluation: PolicyEvaluation
    options: OdometryOptions

    @classmethod
    def load(cls, sequences: tuple[str, ...], setup: TrainingSetup,
             backbone: Backbone) -> PolicyTest:
        """Return the test, with its sequences encoded as in use; raises KfvoError."""
        cache = setup.sequence_cache(backbone)
        encoded = [cache.sequence(text) for text in progress(sequences, 'sequence', 'test')]
        signature = factory.signature_of(setup.odometry, backbone)
        return cls(sequences, PolicyEvaluation(encoded, backbone, signature), setup.odometry)

    def file_results(self, row: str, seed: int, policy: Path) -> list[PolicyResult]:
        """Return the results of a policy file; raises KfvoError for one that does not fit."""
        return self.results(row, seed, read_policy(policy).policy(self.evaluation.signature))

    def results(self, row: str, seed: int | None, policy: KeyframePolicy) -> list[PolicyResult]:
        """Return the results of a policy on all sequences."""
        return [PolicyResult(row, seed, name, score.ate_percent, score.kept)
                for name, score in zip(self.sequences, self.evaluation.scores(policy),
                                       strict=True)]

    def reference_results(self, recipe: TrainingConfig) -> Iterator[PolicyResult]:
        """Yield the results of policies without training, and of trivial trajectories.

        The expert, the random policy and the guard alone are those of the recipe.
        """
        guard = recipe.guard or NO_GUARD
        policies = reference_policies(recipe, self.options, self.evaluation.backbone)
        for name, policy in policies.items():
            yield from self.results(name, None, policy)
        for seed in RANDOM_SEEDS:
            yield from self.results(RandomPolicy.name, seed, RandomPolicy(guard, seed))
        if recipe.guard is not None:
            yield from self.results(GuardOnly.name, None, GuardOnly(guard))
        for trivial in (metrics.constant_position, metrics.straight_line):
            for name, sequence in zip(self.sequences, self.evaluation.sequences, strict=True):
                percent = ate_percent(trivial(sequence.truth.stamps_ns), sequence)
                yield PolicyResult(trivial.__name__, None, name, percent, 0.0)


@contextmanager
def _writing_errors(folder: Path) -> Iterator[None]:
    """Turn errors of the file system into KfvoError."""
    try:
        yield
    except OSError as error:
        raise KfvoError(f'cannot write to {folder}: {reason_of(error)}') from error
