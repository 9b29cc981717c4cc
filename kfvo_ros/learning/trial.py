# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One training of an ablation, and whether it has come to its end already."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from kfvo_ros.atomic import replaced
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.keyframes.policy_file import read_policy
from kfvo_ros.learning.files import SUFFIX, TrainingFiles
from kfvo_ros.learning.recipe import Recipe


@dataclass(frozen=True)
class Trial:
    """The ``recipe`` of a ``row``, learned with a ``seed``, all in one folder."""

    row: str
    seed: int
    recipe: Recipe
    folder: Path

    @property
    def files(self) -> TrainingFiles:
        """What the training writes."""
        return TrainingFiles(str(self.folder / f'{self.row}-{self.seed}{SUFFIX}'))

    @property
    def recipe_file(self) -> Path:
        """The recipe, which the seeds of a row share."""
        return self.folder / f'{self.row}.yaml'

    def prepare(self, resume: bool) -> None:
        """Write the recipe; raises KfvoError at an earlier training that is not to `resume`."""
        earlier = [path for path in (self.files.output, self.files.folder) if path.exists()]
        if earlier and not resume:
            raise KfvoError(f'{earlier[0]} is there already; choose another --output, or add '
                            '--resume to go on')
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with replaced(self.recipe_file) as draft:
                draft.write_text(yaml.safe_dump(asdict(self.recipe), sort_keys=False),
                                 encoding='utf-8')
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error

    def is_complete(self, sequences: Sequence[str], validation: Sequence[str]) -> bool:
        """Whether all that was learned already, for as many steps; raises KfvoError."""
        if not (self.files.output.exists() and self.files.last.exists()):
            return False
        told = read_policy(self.files.last).training
        wanted = {'recipe': asdict(self.recipe), 'seed': self.seed, 'sequences': sequences,
                  'validation': validation}
        return (told.get('steps', 0) >= self.recipe.steps
                and all(told.get(name) == value
                        for name, value in json.loads(json.dumps(wanted)).items()))
