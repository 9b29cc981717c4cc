# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""PlaybackClock: bag time against wall time."""

from __future__ import annotations

import time

import numpy as np
import pytest
from bag_writers import START_NS
from ros_processes import rclpy  # noqa: F401  (skips where it is missing)

from kfvo_ros.ros.player import PlaybackClock


def test_playback_is_never_early_and_does_not_drift():
    clock = PlaybackClock(rate=10.0)
    began = time.monotonic_ns()
    clock.start(START_NS)
    for index in range(100):
        lateness_ns = clock.wait_until(START_NS + index * 20_000_000)
        elapsed_ns = time.monotonic_ns() - began
        assert elapsed_ns >= index * 2_000_000 + lateness_ns
        if index == 50:
            time.sleep(0.09)  # a delay is caught up
    assert elapsed_ns < 99 * 2_000_000 + 90_000_000


def test_wait_returns_the_lateness():
    clock = PlaybackClock(rate=1.0)
    clock.start(0)
    time.sleep(0.03)
    assert 0.02e9 < clock.wait_until(10_000_000) < 0.5e9


def test_ticks_follow_bag_time():
    ticks = []
    clock = PlaybackClock(2.0, ticks.append, frequency=200.0)
    clock.start(START_NS)
    clock.wait_until(START_NS + 200_000_000)
    assert ticks[0] - START_NS < 20_000_000
    assert len(ticks) == pytest.approx(20, abs=8)
    assert np.median(np.diff(ticks)) == pytest.approx(10_000_000, rel=0.2)
    assert (np.diff(ticks) > 0).all()
