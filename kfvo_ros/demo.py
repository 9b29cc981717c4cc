# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.demo``: the whole way from a rendered room to odometry in ROS 2.

A sequence becomes a bag; kfvo_node and the player run as two processes over DDS, as on a robot;
the trajectory is compared with the truth.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError
from kfvo_ros.rehearsal import Heard, rehearse
from kfvo_ros.sequences import open_sequence
from kfvo_ros.trajectory import Trajectory, read_tum

SEQUENCE = 'synthetic:8:smooth'
BAG, TRAJECTORY, SUMMARY, PICTURE = 'bag', 'trajectory.tum', 'summary.json', 'trajectory.png'


def main(argv: list[str] | None = None) -> int:
    """Run the demonstration; return its exit status."""
    parser = argparse.ArgumentParser(prog='kfvo_demo', description=__doc__)
    parser.add_argument('--output', default='demo', help='folder, emptied of earlier results')
    parser.add_argument('--sequence', default=SEQUENCE, help='synthetic:SEED[:STYLE], or whatever '
                        'kfvo_convert takes and has ground truth (default: %(default)s)')
    arguments = parser.parse_args(argv)
    try:
        summary = _demonstrate(arguments.sequence, Path(arguments.output))
    except ImportError as error:
        from kfvo_ros.requirements import missing_dependency
        print(f'kfvo_demo: error: {missing_dependency(error)}', file=sys.stderr)
        return 1
    except (KfvoError, subprocess.SubprocessError) as error:
        print(f'kfvo_demo: error: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 1
    print(_table(summary, Path(arguments.output)))
    return 0


def _demonstrate(text: str, folder: Path) -> dict[str, Any]:
    """Convert, play, listen and evaluate; return the summary."""
    from kfvo_ros import convert
    sequence = open_sequence(text)
    truth = sequence.ground_truth()
    if truth is None:
        raise KfvoError(f'{text} has no ground truth to compare with')
    shutil.rmtree(folder / BAG, ignore_errors=True)
    for name in (TRAJECTORY, SUMMARY, PICTURE):
        (folder / name).unlink(missing_ok=True)
    print(f'1. {text} to {folder / BAG}', flush=True)
    if convert.main([text, str(folder / BAG)]) != 0:
        raise KfvoError('the sequence could not be converted')
    print('2. kfvo_node and kfvo_play, over DDS', flush=True)
    heard = rehearse(folder / BAG, sequence.topic, {
        'queue_size': 10, 'trajectory_file': str(folder / TRAJECTORY)})
    print('3. evaluation', flush=True)
    return _evaluate(folder, text, truth.trajectory, heard)


def _evaluate(folder: Path, text: str, truth: Trajectory, heard: Heard) -> dict[str, Any]:
    """Write summary and picture."""
    from kfvo_ros.plots import plot_trajectory
    from kfvo_ros.results import evaluate
    from kfvo_ros.sequences.base import GroundTruth
    estimate = read_tum(folder / TRAJECTORY)
    summary = {
        'sequence': text, 'version': __version__, 'frames': heard.received,
        'poses': len(heard.stamps_ns), 'dropped': heard.dropped,
        'keyframes': len(heard.keyframes_ns),
        'latency_ms': {'median': heard.latency_median_ms, 'p95': heard.latency_p95_ms},
        **evaluate(estimate, GroundTruth(truth))}
    (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    if 'ate_rmse_m' not in summary:
        raise KfvoError(f'no ATE: {summary["ground_truth_problem"]}')
    plot_trajectory(folder / PICTURE, estimate, truth, np.array(heard.keyframes_ns),
                    f'kfvo_node on {text}')
    return summary


def _table(summary: dict[str, Any], folder: Path) -> str:
    """Return what a person wants to see."""
    latency = summary['latency_ms']
    share = 100.0 * summary['ate_rmse_m'] / summary['path_length_m']
    rows = [('frames received', summary['frames']), ('poses published', summary['poses']),
            ('frames dropped', summary['dropped']), ('keyframes', summary['keyframes']),
            ('ATE after Sim(3)', f'{summary["ate_rmse_m"]:.4f} m, {share:.2f} % of '
                                 f'{summary["path_length_m"]:.2f} m'),
            ('latency', f'{latency["median"]:.1f} ms median, {latency["p95"]:.1f} ms at 95 %')]
    width = max(len(name) for name, _ in rows)
    return '\n'.join(['', *(f'  {name:{width}}  {value}' for name, value in rows), '',
                      f'{folder / TRAJECTORY}, {folder / SUMMARY}, {folder / PICTURE}'])


if __name__ == '__main__':
    sys.exit(main())
