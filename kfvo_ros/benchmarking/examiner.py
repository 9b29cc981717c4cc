# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the files of a run, and the truth, to a row of results.csv."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from kfvo_ros import metrics
from kfvo_ros.benchmarking.rows import CONSTANT_POSITION, FAILED, STRAIGHT_LINE, Row
from kfvo_ros.benchmarking.runs import Run
from kfvo_ros.benchmarking.scores import score
from kfvo_ros.benchmarking.subjects import Subject
from kfvo_ros.errors import KfvoError
from kfvo_ros.options import SequenceOptions
from kfvo_ros.results import TRAJECTORY
from kfvo_ros.sequences.base import GroundTruth
from kfvo_ros.trajectory import Trajectory, read_tum

NO_TRUTH = 'no ground truth'
STEPS = ('encode', 'estimate', 'head', 'decide')
OF_POSITIONS = ('ate_rmse_m', 'ate_se3_rmse_m', 'ate_percent', 'path_length_m')
"""What can be said of a straight line, which knows nothing of the camera's axes."""


class Examiner:
    """Scores runs; reads the truth of each sequence once, as `reading` says."""

    def __init__(self, reading: SequenceOptions) -> None:
        self._reading = reading
        self._truths: dict[Subject, GroundTruth | None] = {}
        self._trivial: set[Subject] = set()

    def truth(self, subject: Subject) -> GroundTruth | None:
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

    def _never_looking(self, subject: Subject, estimate: Trajectory,
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


def _row(subject: Subject, **values: Any) -> Row:
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
