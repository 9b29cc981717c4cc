# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python benchmarks/node.py``: latency, losses and memory of the node at and above capacity.

The node receives a rendered room at EuRoC's 752x480, first at 20 Hz, then at twice the rate that
it can process.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from kfvo_ros.ros.end_to_end import NodeRun, run_node
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.progress import progress

COMMAND = 'benchmarks/node.py'
RATE_HZ, RENDERED_HZ = 20.0, 30.0
WIDTH, HEIGHT, SEED = 752, 480, 8
OFFLINE_FRAMES = 300
WARM_UP_S = 60
"""Time in which the node allocates all memory it needs: later growth is a leak."""


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark; return its exit status."""
    return run_command(COMMAND, _run, argv)


def _run(argv: list[str]) -> None:
    parser = make_parser(COMMAND, __doc__ or '')
    parser.add_argument('--seconds', type=float, default=60.0, help='length of the stream '
                        '(default: %(default)s)')
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        _compare(Path(folder, 'bag'), max(2, round(RATE_HZ * arguments.seconds)))


def _compare(bag: Path, count: int) -> None:
    """Record `count` frames, run them offline and through the node, and print the results."""
    topic = _record(bag, count)
    fast, paced = _time_offline(bag, 0.0), _time_offline(bag, 1.0 / RATE_HZ)
    overload_hz = 2e3 / float(np.median(fast))
    regular = run_node(bag, topic, {}, RATE_HZ / RENDERED_HZ)
    overloaded = run_node(bag, topic, {}, overload_hz / RENDERED_HZ)
    print()
    print(_format_result('20 Hz', count, paced, regular, RATE_HZ))
    print(_format_result('twice capacity', count, fast, overloaded, overload_hz))


def _record(bag: Path, count: int) -> str:
    """Record `count` rendered frames; return the topic of the images."""
    from kfvo_ros.sequences.bag.recorder import Recorder
    from kfvo_ros.sequences.bag.writer import BagWriter
    from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
    sequence = SyntheticSequence(SEED, 'smooth', count, WIDTH, HEIGHT)
    recorder = Recorder(sequence, BagWriter(bag))
    for frame in progress(sequence, 'frame', 'rendering', count):
        recorder.write(frame)
    recorder.finish(complete=True)
    return sequence.topic


def _time_offline(bag: Path, period_s: float) -> np.ndarray:
    """Return the time per frame of the bag without ROS [ms], with a pause of `period_s` between.

    A processor that idles between frames is slower at each, with or without the node.
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


def _format_result(name: str, sent: int, offline_ms: np.ndarray, run: NodeRun,
                   rate_hz: float) -> str:
    """Return the result of one stream in one line; every image must be accounted for."""
    unaccounted = sent - run.lost_in_transit - run.dropped - len(run.stamps_ns)
    median, p95 = np.percentile(offline_ms, [50, 95])
    return (f'{name} ({rate_hz:.1f} Hz): {sent} images, {run.lost_in_transit} lost in transit, '
            f'{run.received} received, {run.dropped} dropped, {len(run.stamps_ns)} poses, '
            f'{unaccounted} unaccounted for; latency {run.latency_median_ms:.1f} ms (95 %: '
            f'{run.latency_p95_ms:.1f}), offline {median:.1f} ms (95 %: {p95:.1f}): '
            f'{run.latency_median_ms - median:+.1f} ms; memory '
            f'{run.memory_mb[:WARM_UP_S][-1]:.0f} MiB within {WARM_UP_S} s, '
            f'{run.memory_mb[-1]:.0f} at the end')


if __name__ == '__main__':
    sys.exit(main())
