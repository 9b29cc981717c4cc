# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The worker thread and the read-ahead thread."""

from __future__ import annotations

import threading
import time
from itertools import count, islice

import pytest
from ros_processes import wait_until

from kfvo_ros.ros.worker import ReadAhead, Worker


def test_worker_drops_and_counts_the_oldest_items():
    taken, idle, gate = [], threading.Event(), threading.Event()

    def work(item: int) -> None:
        taken.append(item)
        gate.wait(10.0)

    worker = Worker(work, idle.set, 2, 0.05)
    worker.start()
    assert worker.put(0) == 0
    wait_until(lambda: taken)
    assert [worker.put(item) for item in range(1, 6)] == [0, 0, 1, 1, 1]
    assert not idle.is_set() and worker.waiting == 3  # one is in work
    gate.set()
    wait_until(idle.is_set)
    assert worker.waiting == 0
    worker.stop()
    assert taken == [0, 4, 5]


def test_read_ahead_keeps_order_and_raises_an_error_in_its_place():
    def items():
        yield from range(100)
        raise ValueError('damaged')

    received = []
    with ReadAhead(items(), lambda item: 1, 8) as ahead:  # noqa: SIM117
        with pytest.raises(ValueError, match='damaged'):
            received.extend(ahead)
    assert received == list(range(100))


@pytest.mark.parametrize('size', [1, 3, 100])
def test_read_ahead_holds_no_more_than_its_limit(size):
    fetched = []

    def items():
        for number in count():
            fetched.append(number)
            yield number

    with ReadAhead(items(), lambda item: size, 10) as ahead:
        assert list(islice(ahead, 5)) == [0, 1, 2, 3, 4]
        time.sleep(0.1)
        held = -(-10 // size)  # items that reach the limit, and one more fetched
        assert 5 + held <= len(fetched) <= 5 + held + 1
        threads = threading.active_count()
    assert threading.active_count() == threads - 1  # the thread ends when the reader leaves early
