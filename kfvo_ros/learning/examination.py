# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How policies, learned or not, do on drives that nobody learned from, each by itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from kfvo_ros import assembly, metrics
from kfvo_ros.backbones.base import Backbone
from kfvo_ros.keyframes.base import KeyframePolicy
from kfvo_ros.keyframes.learned import Setting
from kfvo_ros.keyframes.rail import NO_RAIL
from kfvo_ros.learning.ablation_table import Outcome
from kfvo_ros.learning.drives import Drive
from kfvo_ros.learning.railed import RailAlone, Random
from kfvo_ros.learning.recipe import Recipe
from kfvo_ros.learning.references import references
from kfvo_ros.learning.validation import Validation, ate_percent
from kfvo_ros.options import OdometryOptions

SEEDS = (0, 1, 2)
"""Seeds of the random policy."""


@dataclass(frozen=True)
class Examination:
    """Runs policies over ``drives``, by the names of their sequences, as an odometry would."""

    drives: Mapping[str, Drive]
    backbone: Backbone
    options: OdometryOptions

    @property
    def setting(self) -> Setting:
        """What a learned policy must fit."""
        return assembly.setting_of(self.options, self.backbone)

    def outcomes(self, row: str, seed: int | None, policy: KeyframePolicy) -> Iterator[Outcome]:
        """Yield how the policy does on one drive after the other."""
        for name, drive in self.drives.items():
            score = Validation([drive], self.backbone, self.setting).score(policy)
            yield Outcome(row, seed, name, score.ate_percent, score.kept)

    def unlearned(self, recipe: Recipe) -> Iterator[Outcome]:
        """Yield how the heuristics do, a recipe's teacher, chance and nothing inside its rail.

        And no odometry at all.
        """
        rail = recipe.rail or NO_RAIL
        for name, policy in references(recipe, self.options, self.backbone).items():
            yield from self.outcomes(name, None, policy)
        for seed in SEEDS:
            yield from self.outcomes(Random.name, seed, Random(rail, seed))
        if recipe.rail is not None:
            yield from self.outcomes(RailAlone.name, None, RailAlone(rail))
        for trivial in (metrics.constant_position, metrics.straight_line):
            for name, drive in self.drives.items():
                percent = ate_percent(trivial(drive.truth.stamps_ns), drive)
                yield Outcome(trivial.__name__, None, name, percent, 0.0)
