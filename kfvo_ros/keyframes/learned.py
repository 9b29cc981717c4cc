# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Learned keyframe policy: a small network run in numpy, and its file.

A policy file is safetensors with JSON metadata: format version, signature (key ``setting``), guard
(key ``rail``), clipping of the observation, training summary and digest, which may be missing.
Its tensors are ``mean``, ``std``, ``layers.N.weight`` and ``layers.N.bias``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy, ObservationLayout, indices_of
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.utils.files import user_path
from kfvo_ros.utils.tensor_files import MAX_NUMBER, is_sane, read_tensors, write_tensors

CLIP = 10.0
"""Standardised observations are clipped to +-CLIP in training, and where a file names no value."""
DROP, KEEP = 0, 1
"""Actions, as indices of the network's outputs."""
METADATA_KEY, FORMAT_VERSION = 'kfvo_policy', 1
EXPECTED = 'expected a policy that kfvo_train wrote'


@dataclass(frozen=True)
class Layer:
    """Linear layer: ``weight`` (out, in), ``bias`` (out,), float32."""

    weight: np.ndarray
    bias: np.ndarray


@dataclass(frozen=True)
class Actor:
    """Policy network: standardisation by ``mean`` and ``std`` (D,), clipping, ReLU layers.

    ``mean`` and ``std`` are float64: float32 would lose the variation of nearly constant inputs.
    """

    mean: np.ndarray
    std: np.ndarray
    layers: tuple[Layer, ...]
    clip: float = CLIP

    def logits(self, observation: np.ndarray) -> np.ndarray:
        """Return the logits (..., 2) of DROP and KEEP for observations (..., D)."""
        x = np.clip((observation - self.mean) / self.std, -self.clip, self.clip).astype(np.float32)
        *hidden, last = self.layers
        for layer in hidden:
            x = np.maximum(x @ layer.weight.T + layer.bias, 0.0)
        return x @ last.weight.T + last.bias


class LearnedPolicy(KeyframePolicy):
    """Takes the more probable action, KEEP in a tie, inside the guard of its training.

    `indices` select the network's inputs from the observation. Source: the paper, section IV-C.
    """

    name = 'learned'

    def __init__(self, actor: Actor, guard: KeyframeGuard, indices: np.ndarray) -> None:
        self._actor, self._guard, self._indices = actor, guard, indices
        self.needs_tracks = guard.needs_tracks

    def decide(self, decision: DecisionInput) -> bool:
        """Return the guard's decision if it forces one, else the network's."""
        forced = self._guard.forced(decision)
        if forced is not None:
            return forced
        logits = self._actor.logits(decision.observation[self._indices])
        return bool(logits[KEEP] >= logits[DROP])


@dataclass(frozen=True)
class PolicySignature:
    """Conditions that a policy is trained for and must be used under.

    ``observation`` lists the parts that the policy sees, or those that an odometry offers.
    """

    backbone: str
    scale_rule: str
    window_size: int
    observation: ObservationLayout

    def mismatch(self, available: PolicySignature) -> str | None:
        """Return why the policy cannot run under the `available` conditions, None if it can."""
        for name in ('backbone', 'scale_rule', 'window_size'):
            trained, used = getattr(self, name), getattr(available, name)
            if trained != used:
                return (f'the policy was trained with {name} {trained}, and is to run with '
                        f'{used}: choose {trained}, or a policy trained with {used}')
        missing = [part for part in self.observation if part not in available.observation]
        if missing:
            return (f'the policy sees {missing} (name, size), which the {self.backbone} backbone '
                    f'does not give: {list(available.observation)}')
        return None


@dataclass(frozen=True)
class PolicyFile:
    """Content of a policy file; ``training`` documents how the policy was trained."""

    actor: Actor
    guard: KeyframeGuard
    signature: PolicySignature
    training: dict[str, Any] = field(default_factory=dict)

    def policy(self, available: PolicySignature) -> LearnedPolicy:
        """Return the policy for an odometry of this signature; raises KfvoError on a mismatch."""
        mismatch = self.signature.mismatch(available)
        if mismatch is not None:
            raise KfvoError(mismatch)
        return LearnedPolicy(self.actor, self.guard,
                             indices_of(self.signature.observation, available.observation))

    def write(self, path: Path) -> None:
        """Write the file atomically; raises KfvoError."""
        tensors = {'mean': self.actor.mean, 'std': self.actor.std}
        for number, layer in enumerate(self.actor.layers):
            tensors |= {f'layers.{number}.weight': layer.weight,
                        f'layers.{number}.bias': layer.bias}
        metadata = {'format_version': FORMAT_VERSION, 'setting': asdict(self.signature),
                    'rail': asdict(self.guard), 'clip': float(self.actor.clip),
                    'training': self.training}
        try:
            write_tensors(path, METADATA_KEY, metadata, tensors)
        except (OSError, SafetensorError) as error:
            raise KfvoError(f'cannot write the policy {path}: {reason_of(error)}') from error


def find_policy(path: str | None, backbone: str) -> Path | None:
    """Return `path`, else the policy file that comes with the backbone, None without one."""
    if path is not None:
        return user_path(path)
    bundled = Path(__file__).with_name(f'{backbone}.safetensors')
    return bundled if bundled.exists() else None


def read_policy(path: Path) -> PolicyFile:
    """Read and validate a policy file; raises KfvoError."""
    try:
        return _parse_policy(*read_tensors(path, METADATA_KEY))
    except (OSError, SafetensorError) as error:
        raise KfvoError(f'cannot read the policy {path}: {EXPECTED}; {reason_of(error)}'
                        ) from error
    except ValueError as error:
        raise KfvoError(f'{path}: {EXPECTED}; {reason_of(error)}') from error
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise KfvoError(f'{path}: {EXPECTED}; {type(error).__name__}: {reason_of(error)}'
                        ) from error


def _parse_policy(metadata: dict[str, Any], tensors: dict[str, np.ndarray]) -> PolicyFile:
    """Return the validated content; raises KeyError, TypeError or ValueError."""
    if metadata['format_version'] != FORMAT_VERSION:
        raise ValueError(f'format version {FORMAT_VERSION} is known, the file is of '
                         f'{metadata["format_version"]}')
    guard, training = KeyframeGuard(**metadata['rail']), metadata['training']
    signature = _parse_signature(metadata['setting'])
    if guard.max_gap is not None:
        _expect(int, 'a whole number', max_gap=guard.max_gap)
    _expect(dict, 'a mapping', training=training)
    clip = metadata.get('clip', CLIP)
    _expect(float, 'a decimal number', clip=clip)
    layers: list[Layer] = []
    while f'layers.{len(layers)}.weight' in tensors:
        prefix = f'layers.{len(layers)}'
        layers.append(Layer(tensors[f'{prefix}.weight'], tensors[f'{prefix}.bias']))
    actor = Actor(tensors['mean'].astype(np.float64), tensors['std'].astype(np.float64),
                  tuple(layers), clip)
    _check_actor(actor, sum(size for _, size in signature.observation))
    return PolicyFile(actor, guard, signature, training)


def _parse_signature(values: dict[str, Any]) -> PolicySignature:
    observation = tuple((name, size) for name, size in values['observation'])
    signature = PolicySignature(**values | {'observation': observation})
    _expect(str, 'a word', backbone=signature.backbone, scale_rule=signature.scale_rule)
    for name, size in observation:
        _expect(str, 'a word', observation=name)
        _expect(int, 'a whole number', observation=size)
    _expect(int, 'a whole number', window_size=signature.window_size)
    return signature


def _expect(kind: type, wanted: str, **values: Any) -> None:
    """Raise TypeError unless all values are exactly of this type: bool is not accepted as int."""
    for name, value in values.items():
        if type(value) is not kind:
            raise TypeError(f'{name}: expected {wanted}, came {value!r}')


def _check_actor(actor: Actor, size: int) -> None:
    """Raise ValueError unless the network maps `size` inputs to two logits by sane numbers."""
    weights = [array for layer in actor.layers for array in (layer.weight, layer.bias)]
    if any(array.dtype != np.float32 for array in weights) \
            or not all(map(is_sane, (*weights, actor.mean, actor.std))) \
            or not (actor.std > 0.0).all():
        raise ValueError(f'float32 numbers up to {MAX_NUMBER:.0e} and a positive std are needed')
    if not 0.0 < actor.clip < float('inf'):
        raise ValueError(f'clip: expected a finite number above 0, came {actor.clip}')
    sizes = [size, *(len(layer.bias) for layer in actor.layers)]
    shapes = [layer.weight.shape for layer in actor.layers]
    if size < 1 or not shapes or shapes != list(zip(sizes[1:], sizes)) \
            or sizes[-1] != len((DROP, KEEP)) \
            or actor.mean.shape != (size,) or actor.std.shape != (size,):
        raise ValueError(f'layers of {shapes} do not lead from {size} numbers to 2')
