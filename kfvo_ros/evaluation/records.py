# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""results.csv: a row for each run, and for the two that never look."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.utils.files import atomic_write

CONSTANT_POSITION, STRAIGHT_LINE = 'constant_position', 'straight_line'
TRIVIAL = (CONSTANT_POSITION, STRAIGHT_LINE)
"""Methods that see nothing: one that is worse has failed."""
FINISHED, FAILED = 'finished', 'failed'


@dataclass(frozen=True)
class Row:
    """A line of results.csv, whose columns these are, in this order; None is an empty cell.

    The first thirteen are an interface, the others are added to. Units are in the names, or are
    those of `Scores`; ``ms_per_frame`` and the steps are medians over the frames. ``problem``
    says why a run failed, or why a finished one has no error.
    """

    sequence: str
    method: str
    backbone: str | None = None
    scale_rule: str | None = None
    frames: int | None = None
    keyframes: int | None = None
    ate_rmse_m: float | None = None
    path_length_m: float | None = None
    ate_percent: float | None = None
    rpe_trans: float | None = None
    rpe_rot_deg: float | None = None
    ms_per_frame: float | None = None
    seed: int | None = None
    status: str = FINISHED
    problem: str | None = None
    dataset: str | None = None
    column: str | None = None
    lost_frames: int | None = None
    ate_scale: float | None = None
    ate_se3_rmse_m: float | None = None
    rpe_trans_per_metre: float | None = None
    rpe_rot_deg_per_metre: float | None = None
    kitti_trans_percent: float | None = None
    kitti_rot_deg_per_100m: float | None = None
    ground_truth_frame: str | None = None
    encode_ms: float | None = None
    estimate_ms: float | None = None
    head_ms: float | None = None
    decide_ms: float | None = None
    ms_per_frame_p95: float | None = None
    peak_rss_mb: float | None = None
    device: str | None = None
    machine: str | None = None
    jobs: int | None = None

    @property
    def kept_percent(self) -> float | None:
        """Share of the frames that became keyframes, None of what keeps none."""
        return 100.0 * self.keyframes / self.frames if self.keyframes and self.frames else None

    @property
    def aggregator_ms(self) -> float | None:
        """What the paper calls so: all that the backbone takes, but for its head."""
        if self.encode_ms is None or self.estimate_ms is None:
            return None
        return self.encode_ms + self.estimate_ms - (self.head_ms or 0.0)


COLUMNS = tuple(each.name for each in fields(Row))


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write the file anew; raises KfvoError."""
    try:
        with atomic_write(path) as draft, draft.open('w', encoding='utf-8', newline='') as file:
            csv.writer(file).writerow(COLUMNS)
            _write(file, rows)
    except OSError as error:
        raise _unwritable(path, error) from error


def append_rows(path: Path, rows: Iterable[Row]) -> None:
    """Add rows to the file at once; raises KfvoError."""
    try:
        with path.open('a', encoding='utf-8', newline='') as file:
            _write(file, rows)
    except OSError as error:
        raise _unwritable(path, error) from error


def in_order(rows: Iterable[Row], sequences: Sequence[str], methods: Sequence[str]) -> list[Row]:
    """Return the rows by sequence, method and seed, each sequence's trivial ones last."""
    methods = (*methods, *TRIVIAL)
    return sorted(rows, key=lambda row: (sequences.index(row.sequence),
                                         methods.index(row.method), row.seed or 0))


def _write(file: Any, rows: Iterable[Row]) -> None:
    csv.DictWriter(file, COLUMNS).writerows(
        {name: _plain(value) for name, value in asdict(row).items()} for row in rows)


def _plain(value: Any) -> Any:
    """Return what a spreadsheet takes for a value and never for a formula."""
    if isinstance(value, str) and value.startswith(('=', '+', '-', '@', '\t', '\r')):
        return f"'{value}"
    return value


def _unwritable(path: Path, error: OSError) -> KfvoError:
    return KfvoError(f'cannot write {path}: {reason_of(error)}')
