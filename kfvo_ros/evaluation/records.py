# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Records of a benchmark: one row of results.csv for each run, with its scores."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.evaluation import metrics
from kfvo_ros.evaluation.plan import BenchmarkSequence
from kfvo_ros.evaluation.results import TRAJECTORY
from kfvo_ros.evaluation.runner import Run
from kfvo_ros.odometry.options import SequenceOptions
from kfvo_ros.sequences.base import GroundTruth
from kfvo_ros.trajectory import Trajectory, read_tum
from kfvo_ros.utils.files import atomic_write

CONSTANT_POSITION, STRAIGHT_LINE = 'constant_position', 'straight_line'
TRIVIAL = (CONSTANT_POSITION, STRAIGHT_LINE)
"""Baselines that use no image: a method that is worse has failed."""
FINISHED, FAILED = 'finished', 'failed'
NO_GROUND_TRUTH = 'no ground truth'
STEPS = ('encode', 'estimate', 'head', 'decide')
POSITION_SCORES = ('ate_rmse_m', 'ate_se3_rmse_m', 'ate_percent', 'path_length_m')
"""Scores of a trivial baseline, whose axes are not those of the camera."""


@dataclass(frozen=True)
class Row:
    """A row of results.csv, whose columns are these fields in this order; None: an empty cell.

    The first thirteen are an interface; new ones are appended. Units are in the names, or are
    those of `Scores`; ``ms_per_frame`` and the steps are medians over the frames. ``problem``
    is why a run failed, or why a finished one has no error.
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
        """Share of the frames that became keyframes, None without keyframes."""
        return 100.0 * self.keyframes / self.frames if self.keyframes and self.frames else None

    @property
    def aggregator_ms(self) -> float | None:
        """The paper's "Aggregator": time of the backbone without its head."""
        if self.encode_ms is None or self.estimate_ms is None:
            return None
        return self.encode_ms + self.estimate_ms - (self.head_ms or 0.0)


COLUMNS = tuple(each.name for each in fields(Row))


@dataclass(frozen=True)
class Scores:
    """Errors of one estimate; None where undefined.

    The Sim(3) scale is removed from the estimate first, except for ``ate_se3_rmse_m``.
    ``ate_scale`` is that scale [m per unit], ``ate_percent`` the ATE in % of the true path.
    ``rpe_trans`` [m] and ``rpe_rot_deg`` are RMSE over one second, ``..._per_metre`` over one
    metre of true path; ``kitti_...`` are KITTI's drift.
    """

    ate_rmse_m: float | None = None
    ate_scale: float | None = None
    ate_se3_rmse_m: float | None = None
    path_length_m: float | None = None
    ate_percent: float | None = None
    rpe_trans: float | None = None
    rpe_rot_deg: float | None = None
    rpe_trans_per_metre: float | None = None
    rpe_rot_deg_per_metre: float | None = None
    kitti_trans_percent: float | None = None
    kitti_rot_deg_per_100m: float | None = None


class Evaluator:
    """Turns runs into rows; reads the ground truth of each sequence once."""

    def __init__(self, options: SequenceOptions) -> None:
        self._options = options
        self._truths: dict[BenchmarkSequence, GroundTruth | None] = {}
        self._with_baselines: set[BenchmarkSequence] = set()

    def ground_truth(self, sequence: BenchmarkSequence) -> GroundTruth | None:
        """Return the ground truth; raises KfvoError where it cannot be read."""
        if sequence not in self._truths:
            self._truths[sequence] = sequence.ground_truth(self._options)
        return self._truths[sequence]

    def rows(self, run: Run, problem: str | None) -> list[Row]:
        """Return the row of a run, and once for each sequence those of the trivial baselines.

        `problem` is why the run failed. The baselines have the frames of that run, so an excerpt
        is compared with an excerpt.
        """
        values = _run_values(run)
        if problem is not None:
            return [_make_row(run.sequence, **values, status=FAILED, problem=problem)]
        try:
            truth, estimate = self.ground_truth(run.sequence), read_tum(run.folder / TRAJECTORY)
            scores = asdict(score(estimate, truth.trajectory)) if truth else {}
        except KfvoError as unscored:
            return [_make_row(run.sequence, **values, problem=str(unscored))]
        if truth is None:
            return [_make_row(run.sequence, **values, problem=NO_GROUND_TRUTH)]
        row = _make_row(run.sequence, **values, **scores, ground_truth_frame=truth.frame)
        return [row, *self._baselines(run.sequence, estimate, truth)]

    def _baselines(self, sequence: BenchmarkSequence, estimate: Trajectory,
                   truth: GroundTruth) -> list[Row]:
        """Return the rows of the trivial baselines, [] after the first call for a sequence."""
        if sequence in self._with_baselines:
            return []
        self._with_baselines.add(sequence)
        rows = []
        for method, baseline in ((CONSTANT_POSITION, metrics.constant_position),
                                 (STRAIGHT_LINE, metrics.straight_line)):
            scores = asdict(score(baseline(estimate.stamps_ns), truth.trajectory))
            rows.append(_make_row(sequence, method=method, frames=len(estimate),
                                  **{name: scores[name] for name in POSITION_SCORES},
                                  ground_truth_frame=truth.frame))
        return rows


def score(estimate: Trajectory, truth: Trajectory) -> Scores:
    """Return all scores that are defined for this pair of trajectories.

    A ground truth that never moves defines no scale, positions without rotation no RPE, a path of
    at most 100 m no drift. Raises KfvoError where the two cannot be associated
    (`metrics.associate_trajectories`).
    """
    unscaled = metrics.absolute_trajectory_error(estimate, truth, with_scale=False)
    errors = {'ate_se3_rmse_m': unscaled.rmse, 'path_length_m': unscaled.path_length}
    with suppress(KfvoError):
        aligned = metrics.absolute_trajectory_error(estimate, truth)
        errors |= {'ate_rmse_m': aligned.rmse,
                   'ate_percent': 100.0 * aligned.rmse / aligned.path_length}
        if metrics.extent(estimate) > 0.0:  # without motion any scale fits
            errors['ate_scale'] = aligned.alignment.scale
    with suppress(KfvoError):
        second = metrics.relative_pose_error(estimate, truth, 1.0, 'seconds')
        errors |= {'rpe_trans': second.trans_rmse, 'rpe_rot_deg': second.rot_rmse_deg}
    with suppress(KfvoError):
        metre = metrics.relative_pose_error(estimate, truth, 1.0, 'metres')
        errors |= {'rpe_trans_per_metre': metre.trans_rmse,
                   'rpe_rot_deg_per_metre': metre.rot_rmse_deg}
    with suppress(KfvoError):
        drift = metrics.kitti_drift(estimate, truth)
        errors |= {'kitti_trans_percent': drift.trans_percent,
                   'kitti_rot_deg_per_100m': drift.rot_deg_per_100m}
    return Scores(**errors)


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write results.csv, in place of an earlier one; raises KfvoError."""
    try:
        with atomic_write(path) as draft, draft.open('w', encoding='utf-8', newline='') as file:
            csv.writer(file).writerow(COLUMNS)
            _write(file, rows)
    except OSError as error:
        raise KfvoError(f'cannot write {path}: {reason_of(error)}') from error


def append_rows(path: Path, rows: Iterable[Row]) -> None:
    """Append rows to results.csv; raises KfvoError."""
    try:
        with path.open('a', encoding='utf-8', newline='') as file:
            _write(file, rows)
    except OSError as error:
        raise KfvoError(f'cannot write {path}: {reason_of(error)}') from error


def sort_rows(rows: Iterable[Row], sequences: Sequence[str], methods: Sequence[str]) -> list[Row]:
    """Return the rows by sequence, method and seed, the baselines last in each sequence."""
    methods = (*methods, *TRIVIAL)
    return sorted(rows, key=lambda row: (sequences.index(row.sequence),
                                         methods.index(row.method), row.seed or 0))


def _make_row(sequence: BenchmarkSequence, **values: Any) -> Row:
    """Return a row of a sequence; `values` by field."""
    return Row(sequence.name, dataset=sequence.dataset, column=sequence.column, **values)


def _run_values(run: Run) -> dict[str, Any]:
    """Return the fields that the files of a run define; most are None after a failure."""
    summary, request = run.summary(), run.request()
    times = summary.get('ms_per_frame', {})
    total = times.get('total', {})
    return {'method': run.method, 'seed': run.seed,
            **{name: summary.get(name) for name in (
                'backbone', 'scale_rule', 'frames', 'keyframes', 'lost_frames', 'peak_rss_mb',
                'device')},
            **{f'{step}_ms': times.get(step, {}).get('median') for step in STEPS},
            'ms_per_frame': total.get('median'), 'ms_per_frame_p95': total.get('p95'),
            'machine': request.get('machine'), 'jobs': request.get('jobs')}


def _write(file: Any, rows: Iterable[Row]) -> None:
    """Write rows to an open file."""
    csv.DictWriter(file, COLUMNS).writerows(
        {name: _escape(value) for name, value in asdict(row).items()} for row in rows)


def _escape(value: Any) -> Any:
    """Return a value that no spreadsheet takes for a formula."""
    if isinstance(value, str) and value.startswith(('=', '+', '-', '@', '\t', '\r')):
        return f"'{value}"
    return value
