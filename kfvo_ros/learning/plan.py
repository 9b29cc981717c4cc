# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is trained, from what was chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from kfvo_ros import assembly
from kfvo_ros.backbones.base import Backbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.learned import Setting
from kfvo_ros.keyframes.rail import NO_RAIL
from kfvo_ros.learning.archive import Archive
from kfvo_ros.learning.recipe import Recipe, unseen
from kfvo_ros.learning.school import Lesson
from kfvo_ros.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.sequences.spelling import spelled_out
from kfvo_ros.tracking import FEATURES

ENOUGH, HELD_OUT = 5, 0.1
"""Of so many sequences, or more, this last share is for validation where none is named."""


@dataclass(frozen=True)
class Plan:
    """A training goes on from a checkpoint of the same plan only.

    ``sequences`` are learned from, ``validation`` chooses the best policy; ``setting`` is the
    policy's, with the parts of the observation that it sees. ``reading`` tells how sequences are
    read, ``vggt`` the choices of that backbone, None where it is another.
    """

    sequences: tuple[str, ...]
    validation: tuple[str, ...]
    seed: int
    setting: Setting
    recipe: Recipe
    reading: SequenceOptions
    vggt: VggtOptions | None

    def seed_at(self, steps: int) -> int:
        """Return the seed of what comes after so many steps: nothing is driven again."""
        return (self.seed + steps) % 2 ** 32


@dataclass(frozen=True)
class Choices:
    """What the command line and the recipe say.

    ``seed`` is the training's. The backbone's, in ``odometry``, is another: what it tracked
    serves trainings of all seeds.
    """

    seed: int
    recipe: Recipe
    odometry: OdometryOptions
    reading: SequenceOptions
    vggt: VggtOptions
    cache: Path | None

    def plan(self, sequences: Sequence[str], validation: Sequence[str],
             backbone: Backbone) -> Plan:
        """Return the plan for a backbone; raises KfvoError.

        Ranges of sequences are spelled out, and some held out where `validation` names none. Of
        the rail there is what the backbone's tracks allow.
        """
        learned, held_out = spelled_out(sequences), spelled_out(validation)
        if not held_out and len(learned) >= ENOUGH:
            count = max(round(HELD_OUT * len(learned)), 1)
            learned, held_out = learned[:-count], learned[-count:]
        recipe = self.recipe
        if recipe.rail is not None and not backbone.offers_tracks:
            recipe = replace(recipe, rail=recipe.rail.without_tracks())
        present = assembly.setting_of(self.odometry, backbone)
        left_out = unseen(recipe.without, present.observation)
        seen = tuple(part for part in present.observation if part[0] not in left_out)
        missing = recipe.teacher.unseen_in(seen) if recipe.teacher is not None else []
        if missing:
            raise KfvoError('teacher: expected null where its pupil does not observe '
                            f'{" and ".join(missing)}')
        return Plan(learned, held_out, self.seed, replace(present, observation=seen), recipe,
                    self.reading, self.vggt if self.odometry.backbone == 'vggt' else None)

    def lesson(self, plan: Plan) -> Lesson:
        """Return what environments are made from."""
        recipe = plan.recipe
        return Lesson(plan.sequences, self.reading, self.odometry, self.vggt,
                      recipe.augmentation, recipe.variants, recipe.tracks, recipe.reward,
                      recipe.span, recipe.alpha, recipe.rail or NO_RAIL,
                      plan.setting.observation, self.cache)

    def archive(self, backbone: Backbone) -> Archive:
        """Return where the drives of a validation come from, with the tracks of an odometry."""
        return Archive(backbone, self.reading,
                       {'seed': self.odometry.seed, 'tracks': FEATURES}, self.cache,
                       live=not backbone.offers_tracks)
