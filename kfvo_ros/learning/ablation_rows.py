# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rows of the ablation: what of a recipe each of them changes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from kfvo_ros.learning.recipe import Recipe
from kfvo_ros.learning.reward import ALPHA

FULL = 'full'
VALIDATIONS = 8
"""A learning curve has so many points or more."""

_PAPER: dict[str, Any] = {'reward': 'paper', 'alpha': ALPHA, 'without': ('signals',),
                          'teacher': None}
ROWS: dict[str, dict[str, Any]] = {
    FULL: _PAPER,
    'without_pose': _PAPER | {'without': ('poses', 'signals')},
    'without_descriptor': _PAPER | {'without': ('descriptor', 'signals')},
    'without_alpha': _PAPER | {'alpha': 0.0},
    'alpha_penalty': _PAPER | {'alpha': -ALPHA},
    'local': {'reward': 'local', 'without': ()},
    'local_signals_only': {'reward': 'local', 'without': ('descriptor', 'poses')},
    'local_untaught': {'reward': 'local', 'without': ('descriptor', 'poses'), 'teacher': None},
}
"""Rows against `FULL`, which is reward and observation of the paper: the mean descriptor and the
relative poses, not the backbone's signals; and our own reward on all that can be seen, on the
signals alone, and from nothing instead of from a teacher."""


def row_recipe(name: str, recipe: Recipe, steps: int) -> Recipe:
    """Return the recipe of a row, of so many steps, validated often enough for a curve."""
    every = min(recipe.validation_every, max(steps // VALIDATIONS, 1))
    return replace(recipe, steps=steps, validation_every=every, **ROWS[name])
