# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The plan of a training, from the recipe and the command line, and its files."""

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
from kfvo_ros.utils.config import required
from kfvo_ros.utils.files import user_path

MIN_SEQUENCES_TO_SPLIT, VALIDATION_SHARE = 5, 0.1
"""With this many sequences, the last share is for validation where none is named."""
SUFFIX = '.safetensors'


@dataclass(frozen=True)
class TrainingPlan:
    """Everything that determines a training; a checkpoint resumes only under the same plan.

    ``validation`` are the sequences that choose the best policy; ``signature`` is the policy's,
    with the parts of the observation that it sees; ``vggt`` is None with another backbone.
    Checkpoints hold it as `to_mapping` returns it.
    """

    sequences: tuple[str, ...] = required()
    validation: tuple[str, ...] = required()
    seed: int = required()
    signature: PolicySignature = required(key='setting')
    recipe: TrainingConfig = required()
    sequence_options: SequenceOptions = required(key='reading')
    vggt: VggtOptions | None = required()

    def seed_at(self, steps: int) -> int:
        """Return the seed of what follows these steps, so that no episode is repeated."""
        return (self.seed + steps) % 2 ** 32


@dataclass(frozen=True)
class TrainingSetup:
    """The choices of the command line and the recipe.

    ``seed`` is the training's. ``odometry`` has the backbone's, which is another: encoded
    sequences serve trainings of all seeds.
    """

    seed: int
    recipe: TrainingConfig
    odometry: OdometryOptions
    sequence_options: SequenceOptions
    vggt: VggtOptions
    cache: Path | None

    def plan(self, sequences: Sequence[str], validation: Sequence[str],
             backbone: Backbone) -> TrainingPlan:
        """Return the plan for a backbone; raises KfvoError.

        Ranges of sequences are expanded, and some are split off for validation where
        `validation` names none. Without tracks only the gap of the guard is kept.
        """
        training, validating = expand_ranges(sequences), expand_ranges(validation)
        if not validating and len(training) >= MIN_SEQUENCES_TO_SPLIT:
            count = max(round(VALIDATION_SHARE * len(training)), 1)
            training, validating = training[:-count], training[-count:]
        recipe = self.recipe
        if recipe.guard is not None and not backbone.offers_tracks:
            recipe = replace(recipe, guard=recipe.guard.without_tracks())
        signature = factory.signature_of(self.odometry, backbone)
        excluded = excluded_parts(recipe.without, signature.observation)
        visible = tuple(part for part in signature.observation if part[0] not in excluded)
        missing = recipe.expert.missing_signals(visible) if recipe.expert is not None else []
        if missing:
            raise KfvoError('teacher: expected null where the policy does not observe '
                            f'{" and ".join(missing)}')
        return TrainingPlan(training, validating, self.seed,
                            replace(signature, observation=visible), recipe,
                            self.sequence_options,
                            self.vggt if self.odometry.backbone == 'vggt' else None)

    def environment_config(self, plan: TrainingPlan) -> EnvironmentConfig:
        """Return the configuration of the plan's environments."""
        recipe = plan.recipe
        return EnvironmentConfig(plan.sequences, self.sequence_options, self.odometry, self.vggt,
                                 recipe.augmentation, recipe.variants, recipe.tracks,
                                 recipe.reward, recipe.span, recipe.alpha,
                                 recipe.guard or NO_GUARD, plan.signature.observation, self.cache)

    def sequence_cache(self, backbone: Backbone) -> EncodedSequenceCache:
        """Return the source of validation and test sequences, with as many tracks as in use."""
        return EncodedSequenceCache(backbone, self.sequence_options,
                                    {'seed': self.odometry.seed, 'tracks': FEATURES}, self.cache,
                                    keep_images=not backbone.offers_tracks)


class TrainingFiles:
    """Files of a training: ``output`` is the best policy, the rest is in ``folder`` beside it.

    These are ``checkpoint``, from which a training resumes, the ``last`` policy, and the logs of
    TensorBoard. Raises KfvoError for an output that is not a .safetensors file.
    """

    def __init__(self, output: str) -> None:
        self.output = user_path(output)
        if self.output.suffix != SUFFIX:
            raise KfvoError(f'expected an --output that ends in {SUFFIX}, came {output}')
        self.folder = self.output.with_suffix('.training')
        self.checkpoint = self.folder / 'checkpoint.pt'
        self.last = self.folder / f'last{SUFFIX}'

    def check(self, resume: bool, overwrite: bool) -> None:
        """Raise KfvoError for files of an earlier training, unless to `resume` or `overwrite`."""
        existing = [path for path in (self.output, self.checkpoint, self.last) if path.exists()]
        if existing and not resume and not overwrite:
            raise KfvoError(f'{existing[0]} is there already; choose another --output, or add '
                            '--resume to go on or --overwrite to replace it')

    def prepare(self, resume: bool) -> None:
        """Make the folder, and remove an earlier training unless to `resume`; raises KfvoError."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not resume:
                for path in (self.checkpoint, self.last, *self.folder.glob('events.out.*')):
                    path.unlink(missing_ok=True)
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error
