# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What each method did on the sequences of one dataset: the lines of a table in the making."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kfvo_ros.evaluation.records import FINISHED, TRIVIAL, Row
from kfvo_ros.evaluation.render import number

Seed = int | None


@dataclass(frozen=True)
class Spread:
    """The median of what the seeds gave, the smallest and the largest."""

    median: float
    least: float
    most: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Spread | None:
        """Return that of any values, None of none."""
        values = tuple(values)
        return cls(float(np.median(values)), min(values), max(values)) if values else None

    def text(self, decimals: int) -> str:
        """Return median, and where they print as different numbers, smallest and largest."""
        least, most = number(self.least, decimals), number(self.most, decimals)
        return number(self.median, decimals) + (f' ({least}–{most})' if least != most else '')


@dataclass(frozen=True)
class MethodResults:
    """One method: ``values`` by column and seed."""

    method: str
    values: dict[str, dict[Seed, float]]

    @property
    def looks(self) -> bool:
        """Whether it is one to compare."""
        return self.method not in TRIVIAL

    def spread(self, column: str) -> Spread | None:
        """Return that of a column, None where there is nothing."""
        return Spread.of(self.values.get(column, {}).values())

    def average(self, columns: Sequence[str]) -> Spread | None:
        """Return the mean over columns of each seed that has them all; their spread."""
        if not columns:
            return None
        seeds = set.intersection(*(set(self.values.get(column, {})) for column in columns))
        return Spread.of(float(np.mean([self.values[column][seed] for column in columns]))
                         for seed in seeds)


def label_of(method: str) -> str:
    """Return what tables call a method."""
    return method.replace('_', ' ') if method in TRIVIAL else method


def methods_of(rows: Iterable[Row]) -> tuple[str, ...]:
    """Return the methods as they come, those that never look last."""
    return tuple(sorted(dict.fromkeys(row.method for row in rows), key=TRIVIAL.__contains__))


def columns_of(rows: Iterable[Row]) -> tuple[str, ...]:
    """Return the columns, one for each sequence."""
    return tuple(dict.fromkeys(str(row.column) for row in rows))


def collect_results(rows: Iterable[Row], methods: Iterable[str], name: str) -> list[MethodResults]:
    """Return a line for each method, of the values in column `name` of results.csv.

    Those of failed runs are left out: they are of another part of the sequence.
    """
    lines = {method: MethodResults(method, {}) for method in methods}
    for row in rows:
        value = getattr(row, name)
        if row.status == FINISHED and value is not None:
            lines[row.method].values.setdefault(str(row.column), {})[row.seed] = value
    return list(lines.values())


def common_columns(lines: Iterable[MethodResults], columns: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that every line has which has any: averages are over these."""
    present = [line for line in lines if line.values]
    return tuple(column for column in columns
                 if present and all(column in line.values for line in present))
