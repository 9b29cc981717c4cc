# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a learned policy is measured by."""

from __future__ import annotations

from dataclasses import replace

from kfvo_ros import assembly
from kfvo_ros.backbones.base import Backbone
from kfvo_ros.keyframes import HEURISTICS
from kfvo_ros.keyframes.base import KeyframePolicy
from kfvo_ros.keyframes.rail import NO_RAIL
from kfvo_ros.learning.railed import Taught
from kfvo_ros.learning.recipe import Recipe
from kfvo_ros.options import OdometryOptions


def references(recipe: Recipe, options: OdometryOptions,
               backbone: Backbone) -> dict[str, KeyframePolicy]:
    """Return the heuristics, and the recipe's teacher inside its rail, by their names."""
    policies = {name: assembly.make_policy(replace(options, keyframes=name), backbone)
                for name in HEURISTICS}
    if recipe.teacher is not None:
        policies[Taught.name] = Taught(recipe.rail or NO_RAIL, recipe.teacher,
                                       assembly.setting_of(options, backbone).observation)
    return policies
