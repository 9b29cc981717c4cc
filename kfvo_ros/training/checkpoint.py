# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where a training stands, in a file of tensors and plain values; no pickled object is read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.training.plan import TrainingPlan
from kfvo_ros.utils.files import atomic_write

FORMAT_VERSION = 1
RETURNS = 'returns'
EXPECTED = 'expected a checkpoint that kfvo_train wrote'
FREE = ('recipe.steps', 'recipe.validation_every', 'vggt.device', 'vggt.recompute', 'vggt.compile')
"""What may be another one when a training goes on."""


@dataclass(frozen=True)
class Checkpoint:
    """``plan`` tells what is trained; ``steps`` it learned from; ``best`` ATE [%] so far.

    ``parameters`` are the networks' and Adam's as stable-baselines3 names them, ``statistics``
    mean, variance and count of what was observed and returned.
    """

    plan: dict[str, Any]
    steps: int
    best: float
    parameters: dict[str, Any]
    statistics: dict[str, dict[str, Any]]

    @classmethod
    def of(cls, model: PPO, plan: TrainingPlan, steps: int, best: float) -> Checkpoint:
        """Return where the training of a plan stands."""
        statistics = {name: {'mean': torch.as_tensor(seen.mean), 'var': torch.as_tensor(seen.var),
                             'count': float(seen.count)}
                      for name, seen in statistics_of(model).items()}
        return cls(asdict(plan), steps, best, model.get_parameters(), statistics)

    def write(self, path: Path) -> None:
        """Write the file, in place of an older one at once; raises KfvoError."""
        try:
            with atomic_write(path) as draft:
                torch.save({'format_version': FORMAT_VERSION} | vars(self), draft)
        except (OSError, RuntimeError) as error:  # torch tells of a full disk in a RuntimeError
            raise KfvoError(f'cannot write the checkpoint {path}: {reason_of(error)}') from error

    def restore(self, model: PPO) -> None:
        """Put everything back into a model of the same plan; raises KfvoError."""
        try:
            for name, seen in statistics_of(model).items():
                stored = self.statistics[name]
                mean, var = (stored[each].numpy() for each in ('mean', 'var'))
                if mean.shape != seen.mean.shape or var.shape != seen.var.shape:
                    raise ValueError(f'{name}: {mean.shape} numbers for {seen.mean.shape}')
                seen.mean, seen.var, seen.count = mean, var, float(stored['count'])
            model.set_parameters(self.parameters, device=model.device)
        except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise KfvoError(f'the checkpoint does not fit: {EXPECTED}; {reason_of(error)}'
                            ) from error
        model.num_timesteps = self.steps


def statistics_of(model: PPO) -> dict[str, RunningMeanStd]:
    """Return the running statistics of a model's observations and returns, by name."""
    environment = model.get_vec_normalize_env()
    assert isinstance(environment, VecNormalize) and isinstance(environment.obs_rms, dict)
    return environment.obs_rms | {RETURNS: environment.ret_rms}


def read_checkpoint(path: Path, plan: TrainingPlan) -> Checkpoint:
    """Read the checkpoint of a plan; raises KfvoError for any other file."""
    if not path.exists():
        raise KfvoError(f'there is no checkpoint {path} to go on from: leave --resume out')
    try:
        content = torch.load(path, map_location='cpu', weights_only=True)
        if content.pop('format_version') != FORMAT_VERSION:
            raise ValueError(f'format version {FORMAT_VERSION} is known')
        checkpoint = Checkpoint(**content)
        if not isinstance(checkpoint.steps, int) or not isinstance(checkpoint.best, float):
            raise TypeError(f'{checkpoint.steps!r} steps, best {checkpoint.best!r}')
        if not isinstance(checkpoint.plan, dict) or not _is_plain(checkpoint.plan):
            raise TypeError('a plan of plain values is needed')
    except Exception as error:  # of what is no checkpoint torch's reader raises whatever comes
        # Its own words advise to let the code in the file run.
        raise KfvoError(f'{path}: {EXPECTED}; something else came') from error
    changed = list(changes(checkpoint.plan, asdict(plan)))
    if changed:
        raise KfvoError(f'{path} is of another training: {"; ".join(changed)}. Go on as it '
                        'began, or begin anew with kfvo_train --overwrite')
    return checkpoint


def _is_plain(value: Any) -> bool:
    """Whether a tree is of words, numbers and None alone: tensors do not compare as a whole."""
    if isinstance(value, dict):
        return all(isinstance(name, str) and _is_plain(each) for name, each in value.items())
    if isinstance(value, (list, tuple)):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, (str, int, float))


def changes(before: Any, now: Any, place: str = '') -> Iterator[str]:
    """Yield where two trees of plain values differ, in words.

    What a file does not tell, because an older version wrote it, is as it is now.
    """
    if place in FREE:
        return
    if isinstance(before, dict) and isinstance(now, dict):
        for name in sorted(before):
            yield from changes(before[name], now.get(name), f'{place}.{name}'.lstrip('.'))
    elif before != now:
        yield f'{place} was {before!r}, now {now!r}'
