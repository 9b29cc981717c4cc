# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of kfvo_node that need no second process."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from ros_processes import wait_until

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.ros import diagnostics as monitoring
from kfvo_ros.ros import messages
from kfvo_ros.ros.subscriptions import SequenceGapCounter
from kfvo_ros.ros.worker import Worker
from kfvo_ros.trajectory import NANOSECONDS

serialization = pytest.importorskip('rclpy.serialization')


def test_messages_hold_what_they_are_given():
    """Also after their way over the wire, which a value of a wrong type does not survive."""
    def sent(message):
        return serialization.deserialize_message(serialization.serialize_message(message),
                                                 type(message))

    pose = geometry.make_transform(geometry.exp_so3(np.array([-0.7, 0.4, 1.9])),
                                   np.array([3.0, -2.0, 0.5]))
    covariances = np.random.default_rng(0).normal(size=(2, 6, 6))
    stamp_ns = 12 * NANOSECONDS + 345_678_901
    transform = sent(messages.make_transform(stamp_ns, 'odom', 'base_link', pose))
    np.testing.assert_allclose(messages.to_transform(transform), pose, atol=1e-12)
    assert messages.to_stamp_ns(transform.header.stamp) == stamp_ns
    assert (transform.header.frame_id, transform.child_frame_id) == ('odom', 'base_link')
    odometry = sent(messages.make_odometry(stamp_ns, 'odom', 'base_link', pose, covariances[0],
                                           np.arange(6), covariances[1]))
    twist = odometry.twist.twist
    assert [getattr(part, axis) for part in (twist.linear, twist.angular)
            for axis in 'xyz'] == list(range(6))
    np.testing.assert_array_equal(odometry.pose.covariance, covariances[0].ravel())
    np.testing.assert_array_equal(odometry.twist.covariance, covariances[1].ravel())
    path = sent(messages.make_path('odom', [(1, pose), (stamp_ns, np.eye(4))]))
    assert path.header == path.poses[-1].header and path.header.frame_id == 'odom'
    assert messages.make_path('odom', []).poses == []


def test_worker_takes_the_newest_and_counts_what_is_dropped():
    taken, idle, gate = [], threading.Event(), threading.Event()

    def work(item: int) -> None:
        taken.append(item)
        gate.wait(10.0)

    worker = Worker(work, idle.set, 2, 0.05)
    worker.start()
    assert worker.put(0) == 0
    wait_until(lambda: taken)
    assert [worker.put(item) for item in range(1, 6)] == [0, 0, 1, 1, 1]
    assert not idle.is_set()
    gate.set()
    wait_until(idle.is_set)
    worker.stop()
    assert taken == [0, 4, 5]


@pytest.mark.parametrize('publishers', [1, 2, 3])
@pytest.mark.parametrize('seed', range(20))
def test_lost_messages_are_counted_whoever_sent_them(publishers, seed):
    """Each publisher's numbers rise from somewhere; nobody tells which are whose."""
    random = np.random.default_rng(seed)
    streams, lost = [], 0
    for _ in range(publishers):
        came = random.random(100) < 0.7
        came[[0, -1]] = True  # what was lost before and after these, nobody can know
        numbers = random.choice([1, 1000]) + np.flatnonzero(came)
        lost += int((~came).sum())
        streams.append(list(map(int, numbers)))
    numbering, found = SequenceGapCounter(), 0
    numbering.begin(publishers)
    found += sum(numbering.missing(stream.pop(0)) for stream in streams)
    while any(streams):
        stream = streams[random.choice([i for i, left in enumerate(streams) if left])]
        found += numbering.missing(stream.pop(0))
    assert lost > 10 and found == lost


def test_publishers_that_come_anew_lost_nothing():
    numbering = SequenceGapCounter()
    numbering.begin(1)
    assert [numbering.missing(number) for number in (7, 8, 11)] == [0, 0, 2]
    numbering.begin(1)  # it was started again
    assert [numbering.missing(number) for number in (30, 31, 33)] == [0, 0, 1]
    assert [numbering.missing(number) for number in (1, 2, 4)] == [0, 0, 1]  # untold
    numbering.begin(2)
    assert [numbering.missing(number) for number in (5, 500, 6, 503)] == [0, 0, 0, 2]
    assert numbering.missing(None) == 0


def test_monitor_measures_rates_and_latencies(monkeypatch):
    now = 0.0
    monkeypatch.setattr(monitoring, 'time', SimpleNamespace(monotonic=lambda: now))
    monitor = monitoring.Diagnostics()

    def values() -> dict[str, str]:
        status, = monitor.message(messages.make_header(1, ''), 'name', '/image', {}).status
        return {pair.key: pair.value for pair in status.values}

    for index in range(20):
        now = 0.1 * index
        arrival = monitor.image()
        if index % 2:
            now += 1e-3 * index
            monitor.posed(arrival, Status.OK, index == 1)
    measured = values()
    assert (measured['input rate [Hz]'], measured['output rate [Hz]']) == ('10.0', '5.0')
    assert (measured['latency median [ms]'], measured['latency 95 % [ms]']) == ('10.0', '18.1')
    assert measured['keyframe ratio'] == '0.100'
    now += 6.0
    assert (values()['input rate [Hz]'], values()['output rate [Hz]']) == ('0.0', '0.0')


def test_monitor_tells_what_is_wrong(monkeypatch):
    monitor = monitoring.Diagnostics()

    def told() -> tuple[int, str]:
        status, = monitor.message(messages.make_header(1, ''), 'name', '/image', {}).status
        return int.from_bytes(status.level, 'little'), status.message

    assert told() == (0, 'waiting for the first image')
    monitor.posed(monitor.image(), Status.OK, True)
    assert told() == (0, 'tracking')
    monitor.problem = 'garbage'
    assert told() == (1, 'garbage')
    monitor.posed(monitor.image(), Status.LOST, False)
    assert told() == (1, 'lost')
    assert (monitor.received, monitor.processed, monitor.keyframes, monitor.lost) == (2, 2, 1, 1)
    monkeypatch.setattr(monitoring, 'SILENCE_S', -1.0)
    assert told() == (1, 'no image on /image for 0 s')
    monitor.paused = True
    assert told() == (0, 'paused')
