# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark plan: sequences by methods by seeds, and the runs that follow from it."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.evaluation.runner import Run
from kfvo_ros.keyframes import HEURISTICS
from kfvo_ros.keyframes.learned import find_policy, read_policy
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.sequences import SYNTHETIC
from kfvo_ros.sequences.base import GroundTruth
from kfvo_ros.utils.config import to_arguments
from kfvo_ros.utils.process import host_info

LEARNED = 'learned'
RUNS = 'runs'
EUROC, TUM, KITTI = 'EuRoC', 'TUM-RGBD', 'KITTI'
OTHER = 'Other sequences'
_SEQUENCE_NAMES = tuple((dataset, re.compile(pattern), column) for dataset, pattern, column in (
    (EUROC, r'(MH|V1|V2)_(\d\d)(?:_easy|_medium|_difficult)?', r'\1\2'),
    (EUROC, r'((?:MH|V1|V2)_\d\d.+)', r'\1'),
    (TUM, r'(?:rgbd_dataset_)?(?:freiburg|fr)([123])_(.+)', r'fr\1-\2'),
    (KITTI, r'kitti/(\d\d)', r'\1'),
    ('TartanAir', r'(.+/(?:Easy|Hard)/P\d+)', r'\1'),
    ('Synthetic', r'synthetic:(.+)', r'\1')))
"""Names of a dataset's sequences in any format, and their columns in the paper's tables.

An excerpt has another name than the whole sequence, so it never shares its column.
"""


@dataclass(frozen=True)
class BenchmarkSequence:
    """A sequence; ``text`` is its argument to ``run``. ``name``, ``folder``, ``column``: unique.

    ``name`` is for results, ``folder`` for files and ``column`` for the tables of the ``dataset``.
    """

    text: str
    name: str
    dataset: str
    column: str

    @property
    def folder(self) -> str:
        """The name as a folder name, valid on any file system."""
        return re.sub(r'[^\w.-]+', '_', self.name).strip('.') or '_'

    def ground_truth(self, options: SequenceOptions) -> GroundTruth | None:
        """Read the ground truth; raises KfvoError."""
        return factory.make_sequence(self.text, options).ground_truth()


@dataclass(frozen=True)
class BenchmarkPlan:
    """``sequences`` by ``methods`` by ``seeds``; ``sequence_arguments`` before range expansion.

    ``odometry``, ``vggt`` and ``sequence_options`` hold for all runs; ``policy_sha256`` is the
    checksum of the policy file of the learned method, None without that method.
    """

    sequence_arguments: tuple[str, ...]
    sequences: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    odometry: OdometryOptions
    vggt: VggtOptions
    sequence_options: SequenceOptions
    jobs: int
    folder: Path
    policy_sha256: str | None

    def runs(self, sequences: Iterable[BenchmarkSequence]) -> tuple[Run, ...]:
        """Return all runs, in the order of the tables."""
        conditions = {'machine': host_info(), 'jobs': self.jobs}
        return tuple(
            Run(sequence, method, seed,
                self.folder / RUNS / sequence.folder / method / str(seed),
                self._arguments(method, seed),
                self.policy_sha256 if method == LEARNED else None, conditions)
            for sequence in sequences for method in self.methods for seed in self.seeds)

    @property
    def command(self) -> str:
        """The command line that reproduces the benchmark."""
        policy = self.odometry.policy and Path(self.odometry.policy).name
        return shlex.join([
            'python', '-m', 'kfvo_ros.benchmark', *self.sequence_arguments,
            '--methods', ','.join(self.methods), '--seeds', ','.join(map(str, self.seeds)),
            *to_arguments(replace(self.odometry, policy=policy)), *to_arguments(self.vggt),
            *to_arguments(self.sequence_options), '--output', 'DIR'])

    @property
    def policy_description(self) -> str | None:
        """The learned policy in words: file or backbone, and checksum; None without it."""
        if self.policy_sha256 is None:
            return None
        name = Path(self.odometry.policy).name if self.odometry.policy else \
            f'the policy that comes with the {self.odometry.backbone} backbone'
        return f'{name}, SHA-256 {self.policy_sha256[:12]}...'

    def _arguments(self, method: str, seed: int) -> tuple[str, ...]:
        """Return the arguments of ``run`` after the sequence."""
        odometry = replace(self.odometry, keyframes=method, seed=seed,
                           policy=self.odometry.policy if method == LEARNED else None)
        return (*to_arguments(odometry), *to_arguments(self.vggt),
                *to_arguments(self.sequence_options))


def open_benchmark_sequences(texts: Iterable[str], options: SequenceOptions
                             ) -> tuple[BenchmarkSequence, ...]:
    """Open every sequence once and without duplicates; raises KfvoError for an invalid one.

    Of several sequences of one name the later ones get a number.
    """
    sequences: dict[str, BenchmarkSequence] = {}
    for text in dict.fromkeys(map(_absolute, texts)):
        name = factory.make_sequence(text, options).name
        dataset, column = _dataset_and_column(name)
        sequence, number = BenchmarkSequence(text, name, dataset, column), 1
        while sequence.folder in sequences:
            number += 1
            sequence = replace(sequence, name=f'{name}-{number}', column=f'{column}-{number}')
        sequences[sequence.folder] = sequence
    return tuple(sequences.values())


def default_methods(odometry: OdometryOptions) -> tuple[str, ...]:
    """Return the policies available for these options; raises KfvoError.

    A policy of the backbone that does not match the options is left out.
    """
    path = find_policy(odometry.policy, odometry.backbone)
    available = path is not None and (
        odometry.policy is not None or not _mismatch(path, odometry))
    return (*HEURISTICS, LEARNED) if available else HEURISTICS


def check_policy(methods: Iterable[str], odometry: OdometryOptions) -> str | None:
    """Return the checksum of the learned method's policy file, None without that method.

    Raises KfvoError for a policy that is missing, unused or does not match the options, before
    hours of runs.
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
    mismatch = _mismatch(path, odometry)
    if mismatch is not None:
        raise KfvoError(mismatch)
    return _sha256(path)


def _absolute(text: str) -> str:
    """Return a sequence argument that is valid in every working directory."""
    if text.startswith(f'{SYNTHETIC}:'):
        return text
    return os.path.abspath(os.path.expanduser(text))


def _dataset_and_column(name: str) -> tuple[str, str]:
    """Return the dataset of a sequence, and its column in the tables."""
    for dataset, pattern, column in _SEQUENCE_NAMES:
        match = pattern.fullmatch(name)
        if match is not None:
            return dataset, match.expand(column).replace('_', '-')
    return OTHER, name


def _mismatch(path: Path, odometry: OdometryOptions) -> str | None:
    """Return why the policy cannot run with these options, as far as options determine it."""
    signature = read_policy(path).signature
    return signature.mismatch(replace(
        signature, backbone=odometry.backbone, window_size=odometry.window_size,
        scale_rule=odometry.scale_rule or signature.scale_rule))


def _sha256(path: Path) -> str:
    """Return the SHA-256 of a file; raises KfvoError."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise KfvoError(f'cannot read {path}: {reason_of(error)}') from error
