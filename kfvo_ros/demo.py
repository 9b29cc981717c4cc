# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.demo``: the whole way from a rendered room to odometry in ROS 2.

A sequence becomes a bag; kfvo_node and the player run as two processes over DDS, as on a robot;
the trajectory is compared with the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence
from kfvo_ros.trajectory import Trajectory, read_tum

SEQUENCE = 'synthetic:8:smooth'
BAG, TRAJECTORY, SUMMARY, PICTURE = 'bag', 'trajectory.tum', 'summary.json', 'trajectory.png'
SETTLED_S, PATIENCE_S = 1.5, 60.0
"""Without a new pose for so long the node has caught up; it is waited for so long at most."""
STOP_S = 5.0


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
    # Of its own, so that no other robot in the network hears or disturbs it.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
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
    heard = _run_node(folder, sequence.topic)
    print('3. evaluation', flush=True)
    return _evaluate(folder, text, truth.trajectory, heard)


def _run_node(folder: Path, topic: str) -> dict[str, Any]:
    """Run node and player to the end of the bag; return what was heard of the node."""
    from kfvo_ros.ros.session import spinning
    from kfvo_ros.ros.witness import Witness
    node_command = [sys.executable, '-m', 'kfvo_ros.node', '--ros-args',
                    '-p', f'image_topic:={topic}', '-p', 'queue_size:=10',
                    '-p', f'trajectory_file:={folder / TRAJECTORY}']
    with spinning(Witness, []) as witness, subprocess.Popen(node_command) as node:
        try:
            subprocess.run([sys.executable, '-m', 'kfvo_ros.play', str(folder / BAG), '--topic',
                            topic, '--topic', f'{topic.rpartition("/")[0]}/camera_info',
                            '--wait-for-subscribers'], check=True)
            witness.await_silence(SETTLED_S, PATIENCE_S)
        finally:
            node.terminate()
            try:
                node.wait(STOP_S)
            except subprocess.TimeoutExpired:
                node.kill()
        return {'poses': len(witness.stamps_ns), 'keyframes_ns': witness.keyframes_ns,
                'diagnostics': witness.values}


def _evaluate(folder: Path, text: str, truth: Trajectory, heard: dict[str, Any]
              ) -> dict[str, Any]:
    """Write summary and picture."""
    from kfvo_ros.plots import plot_trajectory
    from kfvo_ros.results import evaluate
    from kfvo_ros.sequences.base import GroundTruth
    estimate = read_tum(folder / TRAJECTORY)
    values = heard['diagnostics']
    summary = {
        'sequence': text, 'version': __version__, 'frames': int(values['images received']),
        'poses': heard['poses'], 'dropped': int(values['images dropped']),
        'keyframes': len(heard['keyframes_ns']),
        'latency_ms': {'median': float(values['latency median [ms]']),
                       'p95': float(values['latency 95 % [ms]'])},
        **evaluate(estimate, GroundTruth(truth))}
    (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    if 'ate_rmse_m' not in summary:
        raise KfvoError(f'no ATE: {summary["ground_truth_problem"]}')
    plot_trajectory(folder / PICTURE, estimate, truth, np.array(heard['keyframes_ns']),
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
