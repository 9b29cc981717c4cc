# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One training of an ablation, and whether it has come to its end already."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from kfvo_ros.atomic import replaced
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.keyframes.policy_file import read_policy
from kfvo_ros.learning.checkpoint import changes, read_checkpoint
from kfvo_ros.learning.files import SUFFIX, TrainingFiles
from kfvo_ros.learning.plan import Plan


@dataclass(frozen=True)
class Trial:
    """The ``plan`` of a ``row`` and a seed, with all others in one folder."""

    row: str
    plan: Plan
    folder: Path

    @property
    def seed(self) -> int:
        """The training's."""
        return self.plan.seed

    @property
    def files(self) -> TrainingFiles:
        """What the training writes."""
        return TrainingFiles(str(self.folder / f'{self.row}-{self.seed}{SUFFIX}'))

    @property
    def recipe_file(self) -> Path:
        """The recipe, which the seeds of a row share."""
        return self.folder / f'{self.row}.yaml'

    def prepare(self, resume: bool) -> None:
        """Make the folder; raises KfvoError at an earlier training, or to `resume` another one."""
        earlier = [path for path in (self.files.output, self.files.folder) if path.exists()]
        if earlier and not resume:
            raise KfvoError(f'{earlier[0]} is there already; choose another --output, or add '
                            '--resume to go on')
        if not self.is_complete():
            if self.files.checkpoint.exists():
                read_checkpoint(self.files.checkpoint, self.plan)
            elif self.files.output.exists():
                raise KfvoError(f'{self.files.output} is of another training, or has lost its '
                                'checkpoint; choose another --output, or remove it')
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error

    def write_recipe(self) -> None:
        """Write the recipe of a training that begins or goes on; raises KfvoError."""
        try:
            with replaced(self.recipe_file) as draft:
                draft.write_text(yaml.safe_dump(asdict(self.plan.recipe), sort_keys=False),
                                 encoding='utf-8')
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error

    def is_complete(self) -> bool:
        """Whether all that was learned already, for as many steps; raises KfvoError."""
        if not (self.files.output.exists() and self.files.last.exists()):
            return False
        wanted = json.loads(json.dumps(asdict(self.plan)))
        told = read_policy(self.files.last).training
        return (told.get('steps', 0) >= self.plan.recipe.steps
                and not any(changes({name: value for name, value in told.items()
                                     if name in wanted}, wanted)))
