# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The file of a learned policy: safetensors, with all that is not a number as JSON in its head."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from kfvo_ros.atomic import replaced
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.keyframes.learned import DROP, KEEP, Actor, Layer, Learned, Setting
from kfvo_ros.keyframes.observation import indices_of
from kfvo_ros.keyframes.rail import Rail

KEY, FORMAT_VERSION = 'kfvo_policy', 1
EXPECTED = 'expected a policy that kfvo_train wrote'


@dataclass(frozen=True)
class PolicyFile:
    """What a file holds; ``training`` tells how the policy came to be, for people."""

    actor: Actor
    rail: Rail
    setting: Setting
    training: dict[str, Any] = field(default_factory=dict)

    def policy(self, present: Setting) -> Learned:
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
            with replaced(path) as draft:
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
    setting, rail, training = head['setting'], Rail(**head['rail']), head['training']
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
    return PolicyFile(actor, rail, Setting(**setting, observation=observation), training)


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
