# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The learned keyframe policy: a small network, run in numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy
from kfvo_ros.keyframes.observation import Layout
from kfvo_ros.keyframes.rail import Rail

CLIP = 10.0
"""A standardised observation goes no farther."""
DROP, KEEP = 0, 1


@dataclass(frozen=True)
class Layer:
    """A linear layer: ``weight`` (out, in), ``bias`` (out,), float32."""

    weight: np.ndarray
    bias: np.ndarray


@dataclass(frozen=True)
class Actor:
    """Observation to preference: standardised by ``mean`` and ``std`` (D,), then ReLU layers.

    ``mean`` and ``std`` are float64: of numbers that hardly vary float32 would lose what they
    vary by.
    """

    mean: np.ndarray
    std: np.ndarray
    layers: tuple[Layer, ...]

    def logits(self, observation: np.ndarray) -> np.ndarray:
        """Return the preferences (..., 2) to drop and to keep for observations (..., D)."""
        x = np.clip((observation - self.mean) / self.std, -CLIP, CLIP).astype(np.float32)
        *hidden, last = self.layers
        for layer in hidden:
            x = np.maximum(x @ layer.weight.T + layer.bias, 0.0)
        return x @ last.weight.T + last.bias


@dataclass(frozen=True)
class Setting:
    """What a policy is trained in, and can be used in: nothing else.

    ``observation`` are the parts of the observation that it sees, or that there are.
    """

    backbone: str
    scale_rule: str
    window_size: int
    observation: Layout

    def require(self, present: Setting) -> None:
        """Raise KfvoError naming both where the present setting is another."""
        misfit = self.misfit(present)
        if misfit is not None:
            raise KfvoError(misfit)

    def misfit(self, present: Setting) -> str | None:
        """Return why the policy cannot be used in the present setting, None where it can."""
        for name in ('backbone', 'scale_rule', 'window_size'):
            mine, theirs = getattr(self, name), getattr(present, name)
            if mine != theirs:
                return (f'the policy was trained with {name} {mine}, and is to run with {theirs}: '
                        f'choose {mine}, or a policy trained with {theirs}')
        missing = [part for part in self.observation if part not in present.observation]
        if missing:
            return (f'the policy sees {missing} (name, size), which the {self.backbone} backbone '
                    f'does not give: {list(present.observation)}')
        return None


class Learned(KeyframePolicy):
    """Keeps where the network prefers to, a tie included, unless the rail decides.

    `indices` are what the network sees of an observation. Source: the paper, section IV-C;
    deployed is the more probable action.
    """

    name = 'learned'

    def __init__(self, actor: Actor, rail: Rail, indices: np.ndarray) -> None:
        self._actor, self._rail, self._indices = actor, rail, indices
        self.needs_tracks = rail.needs_tracks

    def decide(self, decision: DecisionInput) -> bool:
        """Ask the rail, then the network."""
        forced = self._rail.forced(decision)
        if forced is not None:
            return forced
        logits = self._actor.logits(decision.observation[self._indices])
        return bool(logits[KEEP] >= logits[DROP])
