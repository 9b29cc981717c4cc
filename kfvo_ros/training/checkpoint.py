# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a training: files of tensors and plain values, read without unpickling.

The file is one of torch.save, a ZIP archive, whose comment holds the SHA-256 of the rest. Older
versions wrote none.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from kfvo_ros.errors import KfvoError, quoted, reason_of
from kfvo_ros.keyframes.learned import read_policy
from kfvo_ros.training.plan import TrainingFiles, TrainingPlan
from kfvo_ros.utils.config import to_mapping
from kfvo_ros.utils.files import atomic_write, open_file
from kfvo_ros.utils.tensor_files import (
    MAX_BYTES,
    MAX_NUMBER,
    DamagedFileError,
    check_signed_zip,
    is_sane,
    sign_zip,
)

FORMAT_VERSION = 1
RETURNS = 'returns'
EXPECTED = 'expected a checkpoint that kfvo_train wrote'
REPLACE = 'or replace it with kfvo_train --overwrite'
MAY_CHANGE = ('recipe.steps', 'recipe.validation_every', 'vggt.device', 'vggt.recompute',
              'vggt.compile')
"""Keys of the plan that may change when a training resumes."""


@dataclass(frozen=True)
class Checkpoint:
    """State of a training after ``steps`` of its ``plan``; ``best`` is the best ATE [%] so far.

    ``parameters`` of networks and Adam have the names of stable-baselines3; ``statistics`` are
    mean, variance and count of observations and returns.
    """

    plan: dict[str, Any]
    steps: int
    best: float
    parameters: dict[str, Any]
    statistics: dict[str, dict[str, Any]]

    @classmethod
    def of(cls, model: PPO, plan: TrainingPlan, steps: int, best: float) -> Checkpoint:
        """Return the checkpoint of a model."""
        statistics = {name: {'mean': torch.as_tensor(running.mean),
                             'var': torch.as_tensor(running.var), 'count': float(running.count)}
                      for name, running in statistics_of(model).items()}
        return cls(to_mapping(plan), steps, best, model.get_parameters(), statistics)

    def write(self, path: Path) -> None:
        """Write the file atomically; raises KfvoError."""
        content = io.BytesIO()
        torch.save({'format_version': FORMAT_VERSION} | vars(self), content)
        try:
            with atomic_write(path) as draft:
                draft.write_bytes(sign_zip(content.getvalue()))
        except OSError as error:
            raise KfvoError(f'cannot write the checkpoint {path}: {reason_of(error)}') from error

    def restore(self, model: PPO) -> None:
        """Restore a model of the same plan; raises KfvoError."""
        try:
            for name, running in statistics_of(model).items():
                stored = self.statistics[name]
                mean, var = (stored[each].numpy() for each in ('mean', 'var'))
                if mean.shape != running.mean.shape or var.shape != running.var.shape:
                    raise ValueError(f'{name}: {mean.shape} numbers for {running.mean.shape}')
                running.mean, running.var, running.count = mean, var, float(stored['count'])
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
    content = _load(path)
    try:
        if content.pop('format_version') != FORMAT_VERSION:
            raise ValueError(f'format version {FORMAT_VERSION} is known')
        checkpoint = Checkpoint(**content)
        _check(checkpoint)
    except Exception as error:  # another file may hold anything
        raise KfvoError(f'{path}: {EXPECTED}; {reason_of(error)}') from error
    changed = list(differences(checkpoint.plan, to_mapping(plan)))
    if changed:
        raise KfvoError(f'{path} is of another training: {"; ".join(changed)}. Go on as it '
                        f'began, {REPLACE}')
    return checkpoint


def is_finished(files: TrainingFiles, plan: TrainingPlan) -> bool:
    """Whether the files hold the last step of a plan; raises KfvoError where one is damaged."""
    steps = read_checkpoint(files.checkpoint, plan).steps
    policies = [path for path in (files.output, files.last) if path.exists()]
    for path in policies:
        read_policy(path)
    return len(policies) == 2 and steps >= plan.recipe.steps


def differences(before: Any, now: Any, place: str = '') -> Iterator[str]:
    """Yield the differences of two trees of plain values, in words.

    A key that is missing in `before`, as in files of an older version, is no difference.
    """
    if place in MAY_CHANGE:
        return
    if isinstance(before, dict) and isinstance(now, dict):
        for name in sorted(before):
            yield from differences(before[name], now.get(name), f'{place}.{name}'.lstrip('.'))
    elif before != now:
        yield f'{place} was {before!r}, now {now!r}'


def _load(path: Path) -> Any:
    """Return the content of a file; raises KfvoError."""
    try:
        with open_file(path, MAX_BYTES) as file:
            stored = file.read()
        check_signed_zip(stored)
        return torch.load(io.BytesIO(stored), map_location='cpu', weights_only=True)
    except OSError as error:
        raise KfvoError(f'cannot read {path}: {reason_of(error)}') from error
    except DamagedFileError as error:
        raise KfvoError(f'{path}: {EXPECTED}; {error}, {REPLACE}') from error
    except Exception as error:  # torch's reader may raise anything for another file
        # Its messages, which advise to execute code in the file, are not shown.
        raise KfvoError(f'{path}: {EXPECTED}; something else came') from error


def _check(checkpoint: Checkpoint) -> None:
    """Raise TypeError or ValueError for values that no training has."""
    if type(checkpoint.steps) is not int or type(checkpoint.best) is not float:
        raise TypeError(f'{quoted(checkpoint.steps)} steps, best {quoted(checkpoint.best)}')
    if not 0 <= checkpoint.steps <= MAX_NUMBER or math.isnan(checkpoint.best):
        raise ValueError(f'{checkpoint.steps} steps, best {checkpoint.best}')
    if not isinstance(checkpoint.plan, dict) or not _is_plain(checkpoint.plan):
        raise TypeError('a plan of plain values is needed')
    if not _is_sane([checkpoint.parameters, checkpoint.statistics]):
        raise ValueError(f'numbers up to {MAX_NUMBER:.0e} are needed, others came: the training '
                         f'has diverged, or the file is damaged; copy it again, {REPLACE}')


def _is_sane(value: Any) -> bool:
    """Whether all numbers in a tree of tensors and plain values are finite and not absurd."""
    if isinstance(value, dict):
        return all(map(_is_sane, value.values()))
    if isinstance(value, (list, tuple)):
        return all(map(_is_sane, value))
    if isinstance(value, torch.Tensor):
        return is_sane(value.numpy())
    return not isinstance(value, (int, float)) or abs(value) <= MAX_NUMBER


def _is_plain(value: Any) -> bool:
    """Whether a tree holds only words, numbers and None, which compare as a whole."""
    if isinstance(value, dict):
        return all(isinstance(name, str) and _is_plain(each) for name, each in value.items())
    if isinstance(value, (list, tuple)):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, (str, int, float))
