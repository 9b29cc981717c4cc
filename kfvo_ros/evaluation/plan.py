# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a benchmark was asked for, and the runs that this means."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation.runner import Run, sha256_of
from kfvo_ros.evaluation.sequences import BenchmarkSequence
from kfvo_ros.keyframes import HEURISTICS
from kfvo_ros.keyframes.learned import find_policy, read_policy
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.utils.config import to_arguments
from kfvo_ros.utils.process import host_info

LEARNED = 'learned'
RUNS = 'runs'


@dataclass(frozen=True)
class BenchmarkPlan:
    """``sequences`` times ``methods`` times ``seeds``; ``asked`` is how they were called.

    ``odometry``, ``vggt`` and ``reading`` hold for all; ``policy`` is the sum over the file of
    the learned one.
    """

    asked: tuple[str, ...]
    sequences: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    odometry: OdometryOptions
    vggt: VggtOptions
    reading: SequenceOptions
    jobs: int
    folder: Path
    policy: str | None

    def runs(self, subjects: Iterable[BenchmarkSequence]) -> tuple[Run, ...]:
        """Return all runs, in the order of the tables."""
        conditions = {'machine': host_info(), 'jobs': self.jobs}
        return tuple(
            Run(subject, method, seed,
                self.folder / RUNS / subject.folder / method / str(seed),
                self._arguments(method, seed), self.policy if method == LEARNED else None,
                conditions)
            for subject in subjects for method in self.methods for seed in self.seeds)

    @property
    def command(self) -> str:
        """The command line that asks for the same."""
        policy = self.odometry.policy and Path(self.odometry.policy).name
        return shlex.join([
            'python', '-m', 'kfvo_ros.benchmark', *self.asked,
            '--methods', ','.join(self.methods), '--seeds', ','.join(map(str, self.seeds)),
            *to_arguments(replace(self.odometry, policy=policy)), *to_arguments(self.vggt),
            *to_arguments(self.reading), '--output', 'DIR'])

    @property
    def policy_name(self) -> str | None:
        """What the learned policy is, in words."""
        if self.policy is None:
            return None
        name = Path(self.odometry.policy).name if self.odometry.policy else \
            f'the policy that comes with the {self.odometry.backbone} backbone'
        return f'{name}, SHA-256 {self.policy[:12]}...'

    def _arguments(self, method: str, seed: int) -> tuple[str, ...]:
        """Return the arguments of ``run`` after the sequence."""
        odometry = replace(self.odometry, keyframes=method, seed=seed,
                           policy=self.odometry.policy if method == LEARNED else None)
        return (*to_arguments(odometry), *to_arguments(self.vggt), *to_arguments(self.reading))


def default_methods(odometry: OdometryOptions) -> tuple[str, ...]:
    """Return all policies that there are for this odometry; raises KfvoError."""
    path = find_policy(odometry.policy, odometry.backbone)
    comes = path is not None and (odometry.policy is not None or not _misfit(path, odometry))
    return (*HEURISTICS, LEARNED) if comes else HEURISTICS


def fitting_policy(methods: Iterable[str], odometry: OdometryOptions) -> str | None:
    """Return the sum over the policy file, None where nobody learned; raises KfvoError.

    What can be told of a policy without its backbone is told before hours of runs.
    """
    if LEARNED not in methods:
        if odometry.policy is not None:
            raise KfvoError(f'{odometry.policy} is for the method {LEARNED}, which is not among '
                            'the methods: add it, or leave --policy out')
        return None
    path = find_policy(odometry.policy, odometry.backbone)
    if path is None:
        raise KfvoError(f'no policy comes with the {odometry.backbone} backbone for the method '
                        f'{LEARNED}: name one with --policy, or leave {LEARNED} out of --methods')
    misfit = _misfit(path, odometry)
    if misfit is not None:
        raise KfvoError(misfit)
    return sha256_of(path)


def _misfit(path: Path, odometry: OdometryOptions) -> str | None:
    """Return why the policy cannot run in this odometry, as far as options tell."""
    setting = read_policy(path).setting
    return setting.misfit(replace(
        setting, backbone=odometry.backbone, window_size=odometry.window_size,
        scale_rule=odometry.scale_rule or setting.scale_rule))
