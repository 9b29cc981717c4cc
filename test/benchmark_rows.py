# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of results.csv for the tests of tables."""

from __future__ import annotations

from kfvo_ros.evaluation.records import Row


def make_rows(dataset: str, column: str, errors: dict[str, list[float]],
            trivial: tuple[float, float] = (9.0, 8.0)) -> list[Row]:
    """Return the rows of a sequence: by method the ATE [m] of the seeds 0, 1 ...

    `trivial`: those of constant position and straight line.
    """
    names = {'dataset': dataset, 'column': column}
    rows = [Row(f'{dataset}/{column}', method, 'geometric', 'depth', 100, 40, error, 10.0,
                seed=seed, ms_per_frame=12.0, encode_ms=7.0, estimate_ms=4.0, decide_ms=0.5,
                machine='a machine', device='cpu', jobs=1, **names)
            for method, seeds in errors.items() for seed, error in enumerate(seeds)]
    return [*rows, *(Row(f'{dataset}/{column}', method, frames=100, ate_rmse_m=error, **names)
                     for method, error in zip(('constant_position', 'straight_line'), trivial))]
