# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every number by which a benchmark compares an estimate with the truth."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation import metrics
from kfvo_ros.evaluation.metrics import odometry_drift
from kfvo_ros.evaluation.records import CONSTANT_POSITION, FAILED, STRAIGHT_LINE, Row
from kfvo_ros.evaluation.runner import Run
from kfvo_ros.evaluation.sequences import BenchmarkSequence
from kfvo_ros.odometry.options import SequenceOptions
from kfvo_ros.odometry.results import TRAJECTORY
from kfvo_ros.sequences.base import GroundTruth
from kfvo_ros.trajectory import Trajectory, read_tum

NO_TRUTH = 'no ground truth'
STEPS = ('encode', 'estimate', 'head', 'decide')
OF_POSITIONS = ('ate_rmse_m', 'ate_se3_rmse_m', 'ate_percent', 'path_length_m')
"""What can be said of a straight line, which knows nothing of the camera's axes."""


@dataclass(frozen=True)
class Scores:
    """Errors of one estimate; None where there is no such thing.

    The Sim(3) scale is taken out of the estimate first, but for ``ate_se3_rmse_m``.
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


def score(estimate: Trajectory, truth: Trajectory) -> Scores:
    """Return all errors that this pair of trajectories defines.

    No truth that stands still has a scale, no prism a rotation, no path within a room KITTI's
    drift over 100 m. Raises KfvoError where the two do not belong together at all
    (`metrics.match`).
    """
    unscaled = metrics.absolute_trajectory_error(estimate, truth, with_scale=False)
    errors = {'ate_se3_rmse_m': unscaled.rmse, 'path_length_m': unscaled.path_length}
    with suppress(KfvoError):
        aligned = metrics.absolute_trajectory_error(estimate, truth)
        errors |= {'ate_rmse_m': aligned.rmse,
                   'ate_percent': 100.0 * aligned.rmse / aligned.path_length}
        if metrics.extent(estimate) > 0.0:  # what never moved fits at any scale
            errors['ate_scale'] = aligned.alignment.scale
    with suppress(KfvoError):
        second = metrics.relative_pose_error(estimate, truth, 1.0, 'seconds')
        errors |= {'rpe_trans': second.trans_rmse, 'rpe_rot_deg': second.rot_rmse_deg}
    with suppress(KfvoError):
        metre = metrics.relative_pose_error(estimate, truth, 1.0, 'metres')
        errors |= {'rpe_trans_per_metre': metre.trans_rmse,
                   'rpe_rot_deg_per_metre': metre.rot_rmse_deg}
    with suppress(KfvoError):
        drift = odometry_drift(estimate, truth)
        errors |= {'kitti_trans_percent': drift.trans_percent,
                   'kitti_rot_deg_per_100m': drift.rot_deg_per_100m}
    return Scores(**errors)


class Evaluator:
    """Scores runs; reads the truth of each sequence once, as `reading` says."""

    def __init__(self, reading: SequenceOptions) -> None:
        self._reading = reading
        self._truths: dict[BenchmarkSequence, GroundTruth | None] = {}
        self._trivial: set[BenchmarkSequence] = set()

    def truth(self, subject: BenchmarkSequence) -> GroundTruth | None:
        """Return the truth; raises KfvoError where it cannot be read."""
        if subject not in self._truths:
            self._truths[subject] = subject.truth(self._reading)
        return self._truths[subject]

    def rows(self, run: Run, problem: str | None) -> list[Row]:
        """Return the run's row, and with the first of a sequence those that never look.

        They are asked at the frames of that run: of an excerpt, the excerpt is what they miss.
        """
        told = _told(run)
        if problem is not None:
            return [_row(run.subject, **told, status=FAILED, problem=problem)]
        try:
            truth, estimate = self.truth(run.subject), read_tum(run.folder / TRAJECTORY)
            scores = asdict(score(estimate, truth.trajectory)) if truth else {}
        except KfvoError as unscored:
            return [_row(run.subject, **told, problem=str(unscored))]
        if truth is None:
            return [_row(run.subject, **told, problem=NO_TRUTH)]
        row = _row(run.subject, **told, **scores, ground_truth_frame=truth.frame)
        return [row, *self._never_looking(run.subject, estimate, truth)]

    def _never_looking(self, subject: BenchmarkSequence, estimate: Trajectory,
                       truth: GroundTruth) -> list[Row]:
        if subject in self._trivial:
            return []
        self._trivial.add(subject)
        rows = []
        for method, move in ((CONSTANT_POSITION, metrics.constant_position),
                             (STRAIGHT_LINE, metrics.straight_line)):
            scores = asdict(score(move(estimate.stamps_ns), truth.trajectory))
            rows.append(_row(subject, method=method, frames=len(estimate),
                             **{name: scores[name] for name in OF_POSITIONS},
                             ground_truth_frame=truth.frame))
        return rows


def _row(subject: BenchmarkSequence, **values: Any) -> Row:
    return Row(subject.name, dataset=subject.dataset, column=subject.column, **values)


def _told(run: Run) -> dict[str, Any]:
    """Return what the run says of itself, which is little when it failed."""
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
