# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.demo``: from a rendered room to evaluated odometry in ROS 2.

Converts a sequence to a bag, runs kfvo_node and the player as two processes over DDS, as on a
robot, and compares the trajectory with the ground truth.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.signals import raise_if_interrupted

SEQUENCE = 'synthetic:8:smooth'
BAG, TRAJECTORY, SUMMARY, PLOT = 'bag', 'trajectory.tum', 'summary.json', 'trajectory.png'


def main(argv: list[str] | None = None) -> int:
    """Run the demonstration; return its exit status."""
    return run_command('kfvo_demo', _run, argv)


def _run(argv: list[str]) -> None:
    parser = make_parser('kfvo_demo', __doc__ or '')
    parser.add_argument('--output', default='demo', help='folder, emptied of earlier results')
    parser.add_argument('--sequence', default=SEQUENCE, help='synthetic:SEED[:STYLE], or any '
                        'input of kfvo_convert with ground truth (default: %(default)s)')
    arguments = parser.parse_args(argv)
    folder = Path(arguments.output)
    print(_format_table(_run_demo(arguments.sequence, folder), folder))


def _run_demo(text: str, folder: Path) -> dict[str, Any]:
    """Convert, play, listen and evaluate; return the summary."""
    # Heavy imports after the check of the arguments: --help answers at once.
    from kfvo_ros import convert
    from kfvo_ros.odometry.factory import make_backbone
    from kfvo_ros.odometry.options import OdometryOptions
    from kfvo_ros.ros.end_to_end import run_node
    from kfvo_ros.sequences import open_sequence
    sequence = open_sequence(text)
    truth = sequence.ground_truth()
    if truth is None:
        raise KfvoError(f'{text} has no ground truth to compare with')
    shutil.rmtree(folder / BAG, ignore_errors=True)
    for name in (TRAJECTORY, SUMMARY, PLOT):
        (folder / name).unlink(missing_ok=True)
    make_backbone(OdometryOptions())  # compiled at the first start: the node finds it in the cache
    print(f'1. {text} to {folder / BAG}', flush=True)
    if convert.main([text, str(folder / BAG)]) != 0:
        raise_if_interrupted()
        raise KfvoError('the sequence could not be converted')
    print('2. kfvo_node and kfvo_play, over DDS', flush=True)
    run = run_node(folder / BAG, sequence.topic, {
        'queue_size': 10, 'trajectory_file': str(folder / TRAJECTORY)})
    print('3. evaluation', flush=True)
    return _evaluate(folder, text, truth.trajectory, run)


def _evaluate(folder: Path, text: str, truth: Any, run: Any) -> dict[str, Any]:
    """Write summary and plot; return the summary."""
    import numpy as np

    from kfvo_ros.evaluation.plots import plot_trajectory
    from kfvo_ros.evaluation.results import evaluate
    from kfvo_ros.sequences.base import GroundTruth
    from kfvo_ros.trajectory import read_tum
    estimate = read_tum(folder / TRAJECTORY)
    summary = {
        'sequence': text, 'version': __version__, 'frames': run.received,
        'poses': len(run.stamps_ns), 'dropped': run.dropped,
        'lost_in_transit': run.lost_in_transit, 'keyframes': len(run.keyframes_ns),
        'latency_ms': {'median': run.latency_median_ms, 'p95': run.latency_p95_ms},
        **evaluate(estimate, GroundTruth(truth))}
    (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    if 'ate_rmse_m' not in summary:
        raise KfvoError(f'no ATE: {summary["ground_truth_problem"]}')
    plot_trajectory(folder / PLOT, estimate, truth, np.array(run.keyframes_ns),
                    f'kfvo_node on {text}')
    return summary


def _format_table(summary: dict[str, Any], folder: Path) -> str:
    """Return the summary as an aligned table, and the files."""
    latency = summary['latency_ms']
    share = 100.0 * summary['ate_rmse_m'] / summary['path_length_m']
    rows = [('frames received', summary['frames']), ('poses published', summary['poses']),
            ('frames dropped', summary['dropped']),
            ('frames lost in transit', summary['lost_in_transit']),
            ('keyframes', summary['keyframes']),
            ('ATE after Sim(3)', f'{summary["ate_rmse_m"]:.4f} m, {share:.2f} % of '
                                 f'{summary["path_length_m"]:.2f} m'),
            ('latency', f'{latency["median"]:.1f} ms median, {latency["p95"]:.1f} ms at 95 %')]
    width = max(len(name) for name, _ in rows)
    return '\n'.join(['', *(f'  {name:{width}}  {value}' for name, value in rows), '',
                      f'{folder / TRAJECTORY}, {folder / SUMMARY}, {folder / PLOT}'])


if __name__ == '__main__':
    sys.exit(main())
