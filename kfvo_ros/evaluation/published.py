# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Numbers of the paper's tables, for comparison with those measured here."""

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
    """A method's ATE [m] on the sequences of a dataset, and its average as printed."""

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
    """The average ATE [m] of a method by dataset; ``ours`` is its name here, None without one."""

    method: str
    averages: dict[str, float]
    ours: str | None


@dataclass(frozen=True)
class Published:
    """All tables: ATE by dataset, keyframe strategies, the ablation, milliseconds by step."""

    ate: dict[str, PublishedTable]
    strategies: tuple[PublishedAverage, ...]
    ablation: tuple[PublishedAverage, ...]
    runtime: dict[str, Any]
    caveats: tuple[str, ...]

    def has_all(self, dataset: str, columns: Iterable[str]) -> bool:
        """Return whether the paper has all these sequences, so that averages are comparable."""
        return dataset in self.ate and set(columns) <= set(self.ate[dataset].sequences)


@cache
def published() -> Published:
    """Return the content of published.yaml."""
    content = yaml.safe_load(FILE.read_text('utf-8'))
    return Published(
        {dataset: _table(table) for dataset, table in content['ate'].items()},
        tuple(PublishedAverage(**each) for each in content['strategies']),
        tuple(PublishedAverage(**each) for each in content['ablation']),
        content['runtime'], tuple(content['caveats']))


def _table(content: dict[str, Any]) -> PublishedTable:
    rows = (PublishedRow(**row | {'errors': tuple(row['errors'])}) for row in content['rows'])
    return PublishedTable(content['decimals'], tuple(content['sequences']), tuple(rows))
