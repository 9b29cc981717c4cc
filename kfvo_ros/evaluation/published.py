# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the paper reports, to stand beside what was measured here."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

FILE = Path(__file__).with_name('published.yaml')


@dataclass(frozen=True)
class PublishedRow:
    """A method's ATE [m] on the sequences of a dataset, and the average that is printed."""

    method: str
    keyframes: bool
    post_processing: bool
    errors: tuple[float, ...]
    average: float


@dataclass(frozen=True)
class PublishedTable:
    """The ATE table of a dataset."""

    decimals: int
    sequences: tuple[str, ...]
    rows: tuple[PublishedRow, ...]


@dataclass(frozen=True)
class PublishedAverage:
    """The average ATE [m] of a method by dataset; ``ours`` is our name of it, where it has one."""

    method: str
    averages: dict[str, float]
    ours: str | None


@dataclass(frozen=True)
class Published:
    """All tables: ATE by dataset, keyframe strategies, milliseconds by part, the ablation."""

    ate: dict[str, PublishedTable]
    strategies: tuple[PublishedAverage, ...]
    ablation: tuple[PublishedAverage, ...]
    runtime: dict[str, Any]
    caveats: tuple[str, ...]

    def has_all(self, dataset: str, columns: Iterable[str]) -> bool:
        """Whether the paper has these sequences: an average over others is another thing."""
        return dataset in self.ate and set(columns) <= set(self.ate[dataset].sequences)


@cache
def published() -> Published:
    """Return what the file beside this one holds."""
    told = yaml.safe_load(FILE.read_text('utf-8'))
    return Published(
        {dataset: _table(table) for dataset, table in told['ate'].items()},
        tuple(PublishedAverage(**each) for each in told['strategies']),
        tuple(PublishedAverage(**each) for each in told['ablation']),
        told['runtime'], tuple(told['caveats']))


def _table(told: dict[str, Any]) -> PublishedTable:
    rows = (PublishedRow(**row | {'errors': tuple(row['errors'])}) for row in told['rows'])
    return PublishedTable(told['decimals'], tuple(told['sequences']), tuple(rows))
