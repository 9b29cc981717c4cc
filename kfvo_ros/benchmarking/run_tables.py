# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is compared beyond the paper's ATE: all errors of all sequences, and times."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from kfvo_ros.benchmarking.lines import label_of, methods_of
from kfvo_ros.benchmarking.published import published
from kfvo_ros.benchmarking.rows import FINISHED, TRIVIAL, Row
from kfvo_ros.benchmarking.tables import Cell, Table, number, rules_between

ERRORS = (('ATE [m]', 'ate_rmse_m', 4), ('ATE [%]', 'ate_percent', 3),
          ('scale', 'ate_scale', 3), ('ATE SE(3) [m]', 'ate_se3_rmse_m', 4),
          ('RPE 1 s [m]', 'rpe_trans', 4), ('RPE 1 s [deg]', 'rpe_rot_deg', 3),
          ('RPE 1 m [m]', 'rpe_trans_per_metre', 4),
          ('RPE 1 m [deg]', 'rpe_rot_deg_per_metre', 3), ('KITTI [%]', 'kitti_trans_percent', 3),
          ('KITTI [deg/100 m]', 'kitti_rot_deg_per_100m', 3), ('path [m]', 'path_length_m', 2),
          ('kept [%]', 'kept_percent', 1), ('lost', 'lost_frames', 0))
ERROR_NOTES = (
    'ATE: RMSE of the positions of all frames after Sim(3) alignment, also in percent of the '
    'path; the scale [m per unit] that it found; and the same after SE(3) alignment, which leaves '
    'the scale of a single camera in.',
    'RPE: RMSE over one second, and over one metre of true path; KITTI: drift over 100 to 800 m '
    'of path. Both after the Sim(3) scale. A dash: not defined there.')
STEPS = (('Aggregator', 'aggregator_ms'), ('Head', 'head_ms'), ('Decision', 'decide_ms'),
         ('Total', 'ms_per_frame'), ('Total, 95 %', 'ms_per_frame_p95'))
STEP_DECIMALS = 2
STEP_NOTES = (
    'Aggregator: encode and estimate, less the head where the backbone tells it. Medians over the '
    'frames, and over sequences and seeds; medians need not add up.',)
PUBLISHED_NOTE = 'Published: means over EuRoC; the head is the "DPT" of the paper.'


def error_table(rows: Sequence[Row]) -> Table:
    """Return medians over the seeds of every error, a row for each sequence and method."""
    written, ends = [], []
    for sequence in dict.fromkeys(row.sequence for row in rows):
        runs = [row for row in rows if row.sequence == sequence and row.status == FINISHED]
        for method in methods_of(runs):
            cells = [_median(runs, method, name, decimals) for _, name, decimals in ERRORS]
            written.append((Cell(sequence), Cell(label_of(method)), *cells))
        ends.append(len(written))
    return Table('All errors', ('Sequence', 'Method', *(head for head, _, _ in ERRORS)),
                 tuple(written), ERROR_NOTES, words=2, rules=rules_between(*ends))


def runtime_table(by_dataset: dict[str, list[Row]], whole: bool) -> Table:
    """Return how long the parts of a frame took [ms], by dataset, beside the paper's."""
    written: list[tuple[Cell, ...]] = []
    ends = []
    for dataset, rows in by_dataset.items():
        runs = [row for row in rows if row.status == FINISHED and row.method not in TRIVIAL]
        written += [(Cell(dataset), Cell(method), *(
            _median(runs, method, name, STEP_DECIMALS) for _, name in STEPS))
            for method in methods_of(runs)]
        ends.append(len(written))
    paper = published().runtime
    if whole and paper['dataset'] in by_dataset:
        parts = (paper['aggregator'], paper['head'], paper['decide'], paper['total'], None)
        written.append((Cell(paper['dataset']), Cell('Ours (published)'),
                        *(Cell(number(each, STEP_DECIMALS)) for each in parts)))
    notes = [*STEP_NOTES, *_machines(row for rows in by_dataset.values() for row in rows)]
    if len(written) > ends[-1]:
        notes.append(PUBLISHED_NOTE)
    return Table('Time of a frame [ms]', ('Dataset', 'Method', *(head for head, _ in STEPS)),
                 tuple(written), tuple(notes), words=2,
                 rules=rules_between(*ends, len(written)))


def _median(rows: Iterable[Row], method: str, name: str, decimals: int) -> Cell:
    values = [getattr(row, name) for row in rows if row.method == method]
    present = [value for value in values if value is not None]
    return Cell(number(float(np.median(present)) if present else None, decimals))


def _machines(rows: Iterable[Row]) -> list[str]:
    """Return where the runs took place, a line for each kind of place."""
    places = dict.fromkeys((row.machine, row.device, row.jobs) for row in rows
                           if row.machine and row.status == FINISHED)
    return [f'Measured on {machine}{"" if device == "cpu" else f", {device}"}; '
            f'{jobs} {"run" if jobs == 1 else "runs"} side by side.'
            for machine, device, jobs in places]
