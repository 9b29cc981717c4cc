# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of an offline run: trajectory.tum, keyframes.tum and summary.json."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from kfvo_ros.backbones.base import Status
from kfvo_ros.errors import KfvoError, printable, reason_of
from kfvo_ros.evaluation import metrics
from kfvo_ros.odometry.updates import FramePose, Update
from kfvo_ros.sequences.base import GroundTruth
from kfvo_ros.trajectory import Trajectory, format_tum_line
from kfvo_ros.utils.process import peak_rss_mb

PACKAGE = 'kfvo_ros'
MAX_WARNINGS = 50
TRAJECTORY, KEYFRAMES, SUMMARY = 'trajectory.tum', 'keyframes.tum', 'summary.json'


class WarningList(logging.Handler):
    """Collects the warnings that are logged within a ``with`` statement, for the summary.

    ``texts`` holds each once, at most MAX_WARNINGS.
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Take a warning."""
        text = printable(record.getMessage())
        if text not in self.texts and len(self.texts) < MAX_WARNINGS:
            self.texts.append(text)

    def __enter__(self) -> WarningList:
        """Start collecting."""
        logging.getLogger(PACKAGE).addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop collecting."""
        logging.getLogger(PACKAGE).removeHandler(self)


class ResultWriter:
    """Writes poses as they become final, and collects the values of the summary.

    Raises KfvoError if the folder holds results and `overwrite` is not set, and for any write
    error, now or later.
    """

    def __init__(self, folder: Path, overwrite: bool = False) -> None:
        self.folder = folder
        taken = [name for name in (TRAJECTORY, KEYFRAMES, SUMMARY) if (folder / name).exists()]
        if taken and not overwrite:
            raise KfvoError(f'{folder} already holds {", ".join(taken)}; choose another --output '
                            'or add --overwrite')
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._trajectory = (folder / TRAJECTORY).open('w', encoding='ascii')
            self._keyframes = (folder / KEYFRAMES).open('w', encoding='ascii')
            (folder / SUMMARY).unlink(missing_ok=True)
        except OSError as error:
            raise KfvoError(f'cannot write to {folder}: {reason_of(error)}') from error
        self._failure: KfvoError | None = None
        self._stamps_ns: list[int] = []
        self._poses: list[np.ndarray] = []
        self._durations: dict[str, list[float]] = {}
        self._parts: dict[str, list[float]] = {}
        self._depths: list[float] = []
        self._intrinsics: list[np.ndarray] = []
        self._statuses = dict.fromkeys(Status, 0)
        self._keyframe_count = 0

    def update(self, update: Update) -> None:
        """Record the result of one frame."""
        self._statuses[update.status] += 1
        self._keyframe_count += update.is_keyframe
        if update.median_depth is not None:
            self._depths.append(update.median_depth)
        if update.intrinsics is not None:
            self._intrinsics.append(update.intrinsics)
        for times, measured in ((self._durations, update.durations), (self._parts, update.parts)):
            for step, seconds in measured.items():
                times.setdefault(step, []).append(1e3 * seconds)
        self.append(update.final)

    def append(self, final: Iterable[FramePose]) -> None:
        """Append final poses to the files and flush them."""
        with self._writing_errors():
            for each in final:
                pose = each.T_world_camera
                line = format_tum_line(each.stamp_ns, pose)
                self._trajectory.write(line)
                if each.is_keyframe:
                    self._keyframes.write(line)
                self._stamps_ns.append(each.stamp_ns)
                self._poses.append(pose)
            self._trajectory.flush()
            self._keyframes.flush()

    def finish(self, about: dict[str, Any], truth: GroundTruth | None) -> dict[str, Any]:
        """Write summary.json, close the files and return the summary."""
        with self._writing_errors():
            self._trajectory.close()
            self._keyframes.close()
        estimate = Trajectory(np.array(self._stamps_ns, dtype=np.int64),
                              np.array(self._poses).reshape(-1, 4, 4))
        summary = {
            'frames': len(estimate), 'keyframes': self._keyframe_count,
            'lost_frames': self._statuses[Status.LOST],
            'held_frames': self._statuses[Status.HELD], **about,
            'ms_per_frame': self._milliseconds(), 'peak_rss_mb': round(peak_rss_mb(), 1),
            'extent': metrics.extent(estimate) if len(estimate) else 0.0,
            'median_depth': float(np.median(self._depths)) if self._depths else None,
            'max_rotation_deg': metrics.max_rotation_deg(estimate) if len(estimate) else 0.0,
            **self._estimated_intrinsics(), **evaluate(estimate, truth)}
        text = json.dumps(summary, indent=2, allow_nan=False)
        with self._writing_errors():
            (self.folder / SUMMARY).write_text(text + '\n', encoding='utf-8')
        return summary

    def _estimated_intrinsics(self) -> dict[str, dict[str, float | None]]:
        """Return the median intrinsics [px] of a backbone that estimates them."""
        if not self._intrinsics:
            return {}
        K = np.median(self._intrinsics, axis=0)
        # A field of view of zero is an infinite focal length, which JSON cannot express.
        return {'estimated_intrinsics': {
            name: float(value) if np.isfinite(value) else None
            for name, value in zip(('fx', 'fy', 'cx', 'cy'), K[[0, 1, 0, 1], [0, 1, 2, 2]])}}

    @contextmanager
    def _writing_errors(self) -> Iterator[None]:
        """Raise KfvoError for a write error, also in later calls: a line may be incomplete."""
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except OSError as error:
            for file in (self._trajectory, self._keyframes):
                with suppress(OSError):  # closing flushes, which fails again
                    file.close()
            self._failure = KfvoError(f'cannot write to {self.folder}: {reason_of(error)}')
            raise self._failure from error

    def _milliseconds(self) -> dict[str, dict[str, float]]:
        """Return median and 95th percentile [ms] of each step, of their sum and of their parts."""
        steps = {step: np.array(values) for step, values in self._durations.items()}
        if steps:
            steps['total'] = np.sum(list(steps.values()), axis=0)
        steps |= {part: np.array(values) for part, values in self._parts.items()}
        return {step: {'median': round(float(np.median(values)), 3),
                       'p95': round(float(np.percentile(values, 95)), 3)}
                for step, values in steps.items()}


def evaluate(estimate: Trajectory, truth: GroundTruth | None) -> dict[str, Any]:
    """Return the accuracy fields of the summary, else ``ground_truth_problem``."""
    if truth is None:
        return {}
    try:
        error = metrics.absolute_trajectory_error(estimate, truth.trajectory)
        if not np.isfinite([error.rmse, error.alignment.scale, error.path_length]).all():
            raise KfvoError('the error is not finite; expected credible poses')
    except (KfvoError, ValueError, ArithmeticError) as problem:  # of numpy's linear algebra
        return {'ground_truth_frame': truth.frame, 'ground_truth_problem': reason_of(problem)}
    return {'ate_rmse_m': error.rmse, 'ate_alignment': 'sim3', 'ate_scale': error.alignment.scale,
            'path_length_m': error.path_length, 'matched_frames': len(error.errors),
            'ground_truth_frame': truth.frame}
