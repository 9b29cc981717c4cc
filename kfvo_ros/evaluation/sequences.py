# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The sequences of a benchmark: which dataset each is of, and what tables call it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import SequenceOptions
from kfvo_ros.sequences import SYNTHETIC
from kfvo_ros.sequences.base import GroundTruth

EUROC, TUM, KITTI = 'EuRoC', 'TUM-RGBD', 'KITTI'
OTHER = 'Other sequences'
_NAMES = tuple((dataset, re.compile(pattern), column) for dataset, pattern, column in (
    (EUROC, r'(MH|V1|V2)_(\d\d)(?:_easy|_medium|_difficult)?', r'\1\2'),
    (EUROC, r'((?:MH|V1|V2)_\d\d.+)', r'\1'),
    (TUM, r'(?:rgbd_dataset_)?(?:freiburg|fr)([123])_(.+)', r'fr\1-\2'),
    (KITTI, r'kitti/(\d\d)', r'\1'),
    ('TartanAir', r'(.+/(?:Easy|Hard)/P\d+)', r'\1'),
    ('Synthetic', r'synthetic:(.+)', r'\1')))
"""How sequences are called in each dataset, whatever they come as, and in the paper's tables.

An excerpt has another name than the whole: it must not stand in the column of that.
"""


@dataclass(frozen=True)
class BenchmarkSequence:
    """One sequence, which ``run`` calls ``text``; ``name``, ``folder`` and ``column`` are unique.

    ``name`` is for results, ``folder`` for files and ``column`` for the tables of the ``dataset``.
    """

    text: str
    name: str
    dataset: str
    column: str

    @property
    def folder(self) -> str:
        """A name that any file system takes."""
        return re.sub(r'[^\w.-]+', '_', self.name).strip('.') or '_'

    def truth(self, options: SequenceOptions) -> GroundTruth | None:
        """Read the ground truth; raises KfvoError."""
        return factory.make_sequence(self.text, options).ground_truth()


def open_benchmark_sequences(texts: Iterable[str], options: SequenceOptions) -> tuple[BenchmarkSequence, ...]:
    """Open every sequence once, each text once; raises KfvoError for what is none.

    Of several sequences of one name the later ones get a number.
    """
    subjects: dict[str, BenchmarkSequence] = {}
    for text in dict.fromkeys(map(_anywhere, texts)):
        name = factory.make_sequence(text, options).name
        dataset, column = _dataset_of(name)
        subject, number = BenchmarkSequence(text, name, dataset, column), 1
        while subject.folder in subjects:
            number += 1
            subject = replace(subject, name=f'{name}-{number}', column=f'{column}-{number}')
        subjects[subject.folder] = subject
    return tuple(subjects.values())


def _anywhere(text: str) -> str:
    """Return what means the same in every folder."""
    if text.startswith(f'{SYNTHETIC}:'):
        return text
    return os.path.abspath(os.path.expanduser(text))


def _dataset_of(name: str) -> tuple[str, str]:
    """Return dataset and column."""
    for dataset, pattern, column in _NAMES:
        match = pattern.fullmatch(name)
        if match is not None:
            return dataset, match.expand(column).replace('_', '-')
    return OTHER, name
