# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The learned keyframe policy: a small network, run in numpy."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy, ObservationLayout, indices_of
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.utils.files import atomic_write

CLIP = 10.0
"""A standardised observation goes no farther."""
DROP, KEEP = 0, 1
KEY, FORMAT_VERSION = 'kfvo_policy', 1
EXPECTED = 'expected a policy that kfvo_train wrote'


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
class PolicySignature:
    """What a policy is trained in, and can be used in: nothing else.

    ``observation`` are the parts of the observation that it sees, or that there are.
    """

    backbone: str
    scale_rule: str
    window_size: int
    observation: ObservationLayout

    def require(self, present: PolicySignature) -> None:
        """Raise KfvoError naming both where the present setting is another."""
        misfit = self.misfit(present)
        if misfit is not None:
            raise KfvoError(misfit)

    def misfit(self, present: PolicySignature) -> str | None:
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

    def __init__(self, actor: Actor, rail: KeyframeGuard, indices: np.ndarray) -> None:
        self._actor, self._rail, self._indices = actor, rail, indices
        self.needs_tracks = rail.needs_tracks

    def decide(self, decision: DecisionInput) -> bool:
        """Ask the rail, then the network."""
        forced = self._rail.forced(decision)
        if forced is not None:
            return forced
        logits = self._actor.logits(decision.observation[self._indices])
        return bool(logits[KEEP] >= logits[DROP])


@dataclass(frozen=True)
class PolicyFile:
    """What a file holds; ``training`` tells how the policy came to be, for people."""

    actor: Actor
    rail: KeyframeGuard
    setting: PolicySignature
    training: dict[str, Any] = field(default_factory=dict)

    def policy(self, present: PolicySignature) -> Learned:
        """Return the policy for the setting it is to run in; raises KfvoError for another one."""
        self.setting.require(present)
        return Learned(self.actor, self.rail,
                       indices_of(self.setting.observation, present.observation))

    def write(self, path: Path) -> None:
        """Write the file, in place of an older one at once; raises KfvoError."""
        tensors = {'mean': self.actor.mean, 'std': self.actor.std}
        for number, layer in enumerate(self.actor.layers):
            tensors |= {f'layers.{number}.weight': layer.weight,
                        f'layers.{number}.bias': layer.bias}
        head = {'format_version': FORMAT_VERSION, 'setting': asdict(self.setting),
                'rail': asdict(self.rail), 'training': self.training}
        try:
            with atomic_write(path) as draft:
                draft.write_bytes(save({name: np.ascontiguousarray(each)
                                        for name, each in tensors.items()},
                                       {KEY: json.dumps(head)}))
        except (OSError, SafetensorError) as error:
            raise KfvoError(f'cannot write the policy {path}: {reason_of(error)}') from error


def find_policy(named: str | None, backbone: str) -> Path | None:
    """Return the file named, else that of the policy that comes with the backbone, if any."""
    if named is not None:
        return Path(named).expanduser()
    coming_along = Path(__file__).with_name(f'{backbone}.safetensors')
    return coming_along if coming_along.exists() else None


def read_policy(path: Path) -> PolicyFile:
    """Read a file; raises KfvoError for one that is no policy, or is not sound."""
    try:
        with safe_open(path, 'np') as file:
            head = (file.metadata() or {}).get(KEY)
            if head is None:
                raise KfvoError(f'{path} is no policy: {EXPECTED}, other tensors came')
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return _policy(json.loads(head), tensors)
    except (OSError, SafetensorError) as error:
        raise KfvoError(f'cannot read the policy {path}: {EXPECTED}; {reason_of(error)}'
                        ) from error
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise KfvoError(f'{path}: {EXPECTED}; {type(error).__name__}: {reason_of(error)}'
                        ) from error


def _policy(head: dict[str, Any], tensors: dict[str, np.ndarray]) -> PolicyFile:
    """Put a policy together; raises KeyError, TypeError or ValueError where it does not fit."""
    if head['format_version'] != FORMAT_VERSION:
        raise ValueError(f'format version {FORMAT_VERSION} is known, the file is of '
                         f'{head["format_version"]}')
    setting, rail, training = head['setting'], KeyframeGuard(**head['rail']), head['training']
    observation = tuple((name, size) for name, size in setting.pop('observation'))
    _expect(str, 'a word', backbone=setting['backbone'], scale_rule=setting['scale_rule'])
    for name, size in observation:
        _expect(str, 'a word', observation=name)
        _expect(int, 'a whole number', observation=size)
    _expect(int, 'a whole number', window_size=setting['window_size'])
    if rail.max_gap is not None:
        _expect(int, 'a whole number', max_gap=rail.max_gap)
    _expect(dict, 'a mapping', training=training)
    layers: list[Layer] = []
    while f'layers.{len(layers)}.weight' in tensors:
        prefix = f'layers.{len(layers)}'
        layers.append(Layer(tensors[f'{prefix}.weight'], tensors[f'{prefix}.bias']))
    actor = Actor(tensors['mean'].astype(np.float64), tensors['std'].astype(np.float64),
                  tuple(layers))
    _check(actor, sum(size for _, size in observation))
    return PolicyFile(actor, rail, PolicySignature(**setting, observation=observation), training)


def _expect(kind: type, wanted: str, **values: Any) -> None:
    """Raise TypeError for a value that is not of this very kind: True is no whole number."""
    for name, value in values.items():
        if type(value) is not kind:
            raise TypeError(f'{name}: expected {wanted}, came {value!r}')


def _check(actor: Actor, size: int) -> None:
    """Raise ValueError unless observations of `size` go through to two finite preferences."""
    weights = [part for layer in actor.layers for part in (layer.weight, layer.bias)]
    if any(array.dtype != np.float32 for array in weights) \
            or not all(np.isfinite(array).all() for array in (*weights, actor.mean, actor.std)) \
            or not (actor.std > 0.0).all():
        raise ValueError('finite float32 numbers and a positive std are needed')
    sizes = [size, *(len(layer.bias) for layer in actor.layers)]
    shapes = [layer.weight.shape for layer in actor.layers]
    if size < 1 or not shapes or shapes != list(zip(sizes[1:], sizes)) \
            or sizes[-1] != len((DROP, KEEP)) \
            or actor.mean.shape != (size,) or actor.std.shape != (size,):
        raise ValueError(f'layers of {shapes} do not lead from {size} numbers to 2')
