# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Aggregation of rows: values by method, column and seed; medians and averages of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kfvo_ros.evaluation.records import FINISHED, TRIVIAL, Row

Seed = int | None


@dataclass(frozen=True)
class Spread:
    """Median, minimum and maximum over the seeds."""

    median: float
    minimum: float
    maximum: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Spread | None:
        """Return the spread of values, None without values."""
        values = tuple(values)
        return cls(float(np.median(values)), min(values), max(values)) if values else None


@dataclass(frozen=True)
class MethodResults:
    """The results of one method on one dataset: ``values`` by column and seed."""

    method: str
    values: dict[str, dict[Seed, float]]

    def spread(self, column: str) -> Spread | None:
        """Return the spread over the seeds of a column, None without values."""
        return Spread.of(self.values.get(column, {}).values())

    def average(self, columns: Sequence[str]) -> Spread | None:
        """Return the spread of the seeds' means over `columns`, of seeds that have them all."""
        if not columns:
            return None
        seeds = set.intersection(*(set(self.values.get(column, {})) for column in columns))
        return Spread.of(float(np.mean([self.values[column][seed] for column in columns]))
                         for seed in seeds)


def label_of(method: str) -> str:
    """Return the label of a method in tables."""
    return method.replace('_', ' ') if method in TRIVIAL else method


def methods_of(rows: Iterable[Row]) -> tuple[str, ...]:
    """Return the methods in order of appearance, trivial baselines last."""
    return tuple(sorted(dict.fromkeys(row.method for row in rows), key=TRIVIAL.__contains__))


def columns_of(rows: Iterable[Row]) -> tuple[str, ...]:
    """Return the columns, one for each sequence."""
    return tuple(dict.fromkeys(str(row.column) for row in rows))


def group_by_dataset(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return the rows of each dataset."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(str(row.dataset), []).append(row)
    return groups


def collect_results(rows: Iterable[Row], methods: Iterable[str], field: str
                    ) -> list[MethodResults]:
    """Return the results of each method: the values of a `field` of `Row`.

    Failed runs are left out: their errors are of a part of the sequence.
    """
    results = {method: MethodResults(method, {}) for method in methods}
    for row in rows:
        value = getattr(row, field)
        if row.status == FINISHED and value is not None:
            results[row.method].values.setdefault(str(row.column), {})[row.seed] = value
    return list(results.values())


def common_columns(results: Iterable[MethodResults], columns: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that all methods have, those without any values aside.

    Averages are over these.
    """
    present = [each for each in results if each.values]
    return tuple(column for column in columns
                 if present and all(column in each.values for each in present))


def median_of(rows: Iterable[Row], field: str) -> float | None:
    """Return the median of a `field` of `Row`, None where no row has it."""
    present = [value for value in (getattr(row, field) for row in rows) if value is not None]
    return float(np.median(present)) if present else None
