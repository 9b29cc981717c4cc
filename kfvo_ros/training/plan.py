# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is trained, from what was chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.keyframes.guard import NO_GUARD
from kfvo_ros.keyframes.learned import PolicySignature
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.tracking.tracker import FEATURES
from kfvo_ros.training.config import TrainingConfig, excluded_parts
from kfvo_ros.training.sampler import EnvironmentConfig
from kfvo_ros.training.sequence_cache import EncodedSequenceCache
from kfvo_ros.utils.commands import expand_ranges

ENOUGH, HELD_OUT = 5, 0.1
"""Of so many sequences, or more, this last share is for validation where none is named."""
SUFFIX = '.safetensors'


@dataclass(frozen=True)
class TrainingPlan:
    """A training goes on from a checkpoint of the same plan only.

    ``sequences`` are learned from, ``validation`` chooses the best policy; ``setting`` is the
    policy's, with the parts of the observation that it sees. ``reading`` tells how sequences are
    read, ``vggt`` the choices of that backbone, None where it is another.
    """

    sequences: tuple[str, ...]
    validation: tuple[str, ...]
    seed: int
    setting: PolicySignature
    recipe: TrainingConfig
    reading: SequenceOptions
    vggt: VggtOptions | None

    def seed_at(self, steps: int) -> int:
        """Return the seed of what comes after so many steps: nothing is driven again."""
        return (self.seed + steps) % 2 ** 32


@dataclass(frozen=True)
class TrainingSetup:
    """What the command line and the recipe say.

    ``seed`` is the training's. The backbone's, in ``odometry``, is another: what it tracked
    serves trainings of all seeds.
    """

    seed: int
    recipe: TrainingConfig
    odometry: OdometryOptions
    reading: SequenceOptions
    vggt: VggtOptions
    cache: Path | None

    def plan(self, sequences: Sequence[str], validation: Sequence[str],
             backbone: Backbone) -> TrainingPlan:
        """Return the plan for a backbone; raises KfvoError.

        Ranges of sequences are spelled out, and some held out where `validation` names none. Of
        the rail there is what the backbone's tracks allow.
        """
        learned, held_out = expand_ranges(sequences), expand_ranges(validation)
        if not held_out and len(learned) >= ENOUGH:
            count = max(round(HELD_OUT * len(learned)), 1)
            learned, held_out = learned[:-count], learned[-count:]
        recipe = self.recipe
        if recipe.rail is not None and not backbone.offers_tracks:
            recipe = replace(recipe, rail=recipe.rail.without_tracks())
        present = factory.signature_of(self.odometry, backbone)
        left_out = excluded_parts(recipe.without, present.observation)
        seen = tuple(part for part in present.observation if part[0] not in left_out)
        missing = recipe.teacher.unseen_in(seen) if recipe.teacher is not None else []
        if missing:
            raise KfvoError('teacher: expected null where its pupil does not observe '
                            f'{" and ".join(missing)}')
        return TrainingPlan(learned, held_out, self.seed, replace(present, observation=seen), recipe,
                            self.reading, self.vggt if self.odometry.backbone == 'vggt' else None)

    def lesson(self, plan: TrainingPlan) -> EnvironmentConfig:
        """Return what environments are made from."""
        recipe = plan.recipe
        return EnvironmentConfig(plan.sequences, self.reading, self.odometry, self.vggt,
                                 recipe.augmentation, recipe.variants, recipe.tracks, recipe.reward,
                                 recipe.span, recipe.alpha, recipe.rail or NO_GUARD,
                                 plan.setting.observation, self.cache)

    def archive(self, backbone: Backbone) -> EncodedSequenceCache:
        """Return where the drives of a validation come from, with the tracks of an odometry."""
        return EncodedSequenceCache(backbone, self.reading,
                                    {'seed': self.odometry.seed, 'tracks': FEATURES}, self.cache,
                                    live=not backbone.offers_tracks)


class TrainingFiles:
    """``output`` is the best policy; the rest is in the ``folder`` beside it.

    That is ``checkpoint``, from which a training goes on, the ``last`` policy, and the logs of
    TensorBoard. Raises KfvoError for an output that is no .safetensors file.
    """

    def __init__(self, output: str) -> None:
        self.output = Path(output).expanduser()
        if self.output.suffix != SUFFIX:
            raise KfvoError(f'expected an --output that ends in {SUFFIX}, came {output}')
        self.folder = self.output.with_suffix('.training')
        self.checkpoint = self.folder / 'checkpoint.pt'
        self.last = self.folder / f'last{SUFFIX}'

    def check(self, resume: bool, overwrite: bool) -> None:
        """Raise KfvoError where an earlier training is, neither to `resume` nor to `overwrite`."""
        there = [path for path in (self.output, self.checkpoint, self.last) if path.exists()]
        if there and not resume and not overwrite:
            raise KfvoError(f'{there[0]} is there already; choose another --output, or add '
                            '--resume to go on or --overwrite to begin anew')

    def prepare(self, resume: bool) -> None:
        """Make the folder, empty of an earlier training unless to `resume`; raises KfvoError."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not resume:
                for path in (self.checkpoint, self.last, *self.folder.glob('events.out.*')):
                    path.unlink(missing_ok=True)
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error
