# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python benchmarks/node.py``: does the node keep up, and what when it cannot?

A room rendered at EuRoC's 752x480 goes to the node at 20 Hz, then at twice the rate it can take.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from kfvo_ros.ros.end_to_end import NodeRun, run_node
from kfvo_ros.utils.commands import make_parser, run_command

RATE_HZ, RENDERED_HZ = 20.0, 30.0
WIDTH, HEIGHT, SEED = 752, 480, 8
OFFLINE_FRAMES = 300
WARM_S = 60
"""By then the node has all the memory that it needs: what comes later is a leak."""


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark; return its exit status."""
    return run_command('kfvo_node_benchmark', _run, argv)


def _run(argv: list[str]) -> None:
    parser = make_parser('kfvo_node_benchmark', __doc__ or '')
    parser.add_argument('--seconds', type=float, default=60.0, help='length of the stream '
                        '(default: %(default)s)')
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        _compare(Path(folder, 'bag'), max(2, round(RATE_HZ * arguments.seconds)))


def _compare(bag: Path, count: int) -> None:
    """Record the stream, run it offline and through the node, and print what came of it."""
    from tqdm import tqdm

    from kfvo_ros.sequences.bag.recorder import Recorder
    from kfvo_ros.sequences.bag.writer import BagWriter
    from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
    sequence = SyntheticSequence(SEED, 'smooth', count, WIDTH, HEIGHT)
    recorder = Recorder(sequence, BagWriter(bag))
    for frame in tqdm(sequence, total=count, unit='frame', desc='rendering'):
        recorder.write(frame)
    recorder.finish(complete=True)
    hurried, paced = _time_offline(bag, 0.0), _time_offline(bag, 1.0 / RATE_HZ)
    twice_hz = 2e3 / float(np.median(hurried))
    usual = run_node(bag, sequence.topic, {}, RATE_HZ / RENDERED_HZ)
    flooded = run_node(bag, sequence.topic, {}, twice_hz / RENDERED_HZ)
    print()
    for name, offline, heard, rate in (('20 Hz', paced, usual, RATE_HZ),
                                       ('twice capacity', hurried, flooded, twice_hz)):
        print(_line(name, count, offline, heard, rate))


def _time_offline(bag: Path, period_s: float) -> np.ndarray:
    """Return the milliseconds that frames of the bag take without ROS, one each `period_s`.

    A processor that may rest between frames is slower at each: that is not the node's doing.
    """
    from kfvo_ros.odometry.factory import make_odometry
    from kfvo_ros.odometry.options import OdometryOptions
    from kfvo_ros.sequences import open_sequence
    from kfvo_ros.utils.process import single_threaded
    durations = []
    with single_threaded():
        odometry = make_odometry(OdometryOptions())
        for frame, _ in zip(open_sequence(str(bag)), range(OFFLINE_FRAMES)):
            time.sleep(period_s)
            start = time.perf_counter()
            odometry.process(frame)
            durations.append(1e3 * (time.perf_counter() - start))
    return np.array(durations)


def _line(name: str, sent: int, offline: np.ndarray, heard: NodeRun, rate: float) -> str:
    """Return what came of one stream; every image must be accounted for."""
    unaccounted = sent - heard.missed - heard.dropped - len(heard.stamps_ns)
    median, p95 = np.percentile(offline, [50, 95])
    return (f'{name} ({rate:.1f} Hz): {sent} images, {heard.missed} lost in transit, '
            f'{heard.received} received, {heard.dropped} dropped, {len(heard.stamps_ns)} poses, '
            f'{unaccounted} unaccounted for; latency {heard.latency_median_ms:.1f} ms (95 %: '
            f'{heard.latency_p95_ms:.1f}), offline {median:.1f} ms (95 %: {p95:.1f}): '
            f'{heard.latency_median_ms - median:+.1f} ms; memory '
            f'{heard.memory_mb[:WARM_S][-1]:.0f} MiB within {WARM_S} s, '
            f'{heard.memory_mb[-1]:.0f} at the end')


if __name__ == '__main__':
    sys.exit(main())
