# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which runs are drawn: of each sequence and method the first seed that has a trajectory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from kfvo_ros.benchmarking.examiner import Examiner
from kfvo_ros.benchmarking.pictures import Panel, draw_errors, draw_trajectories
from kfvo_ros.benchmarking.runs import Run
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.results import KEYFRAMES, TRAJECTORY
from kfvo_ros.trajectory import read_tum

TRAJECTORIES, ERRORS = 'trajectories.png', 'errors.png'
MOST_SEQUENCES = 11
"""As many as the largest of the paper's tables; more make no picture that can be read."""


def draw(folder: Path, runs: Iterable[Run], examiner: Examiner) -> tuple[Path, ...]:
    """Draw runs that were scored; return the pictures, none of nothing. Raises KfvoError."""
    panels = list(_panels(runs, examiner))
    drawn = tuple(dict.fromkeys(panel.sequence for panel in panels))[:MOST_SEQUENCES]
    panels = [panel for panel in panels if panel.sequence in drawn]
    if not panels:
        return ()
    try:
        draw_trajectories(folder / TRAJECTORIES, panels)
        draw_errors(folder / ERRORS, panels)
    except OSError as error:
        raise KfvoError(f'cannot write to {folder}: {reason_of(error)}') from error
    return folder / TRAJECTORIES, folder / ERRORS


def _panels(runs: Iterable[Run], examiner: Examiner) -> Iterator[Panel]:
    seen = set()
    for run in runs:
        if (run.subject, run.method) not in seen:
            with suppress(KfvoError):  # results.csv tells
                truth = examiner.truth(run.subject)
                if truth is not None:
                    estimate = read_tum(run.folder / TRAJECTORY)
                    seen.add((run.subject, run.method))
                    yield Panel(run.subject.name, run.method, estimate, truth.trajectory,
                                read_tum(run.folder / KEYFRAMES).stamps_ns)
