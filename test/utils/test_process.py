# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Threads, memory, durations and host of the process."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info

from kfvo_ros.errors import KfvoError
from kfvo_ros.utils import process
from kfvo_ros.utils.process import (
    LIMIT_MARGIN,
    TIME_FACTOR,
    Stopwatch,
    available_mb,
    host_info,
    peak_rss_mb,
    rss_mb,
    single_threaded,
    time_limit,
)


def test_host_info_names_processor_cores_and_python():
    name = host_info()
    assert 'cores, Python 3.' in name and not name.startswith(',')


def test_single_threaded_restores_the_number_of_threads():
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        with single_threaded():
            assert cv2.getNumThreads() == 1
            assert {pool['num_threads'] for pool in threadpool_info()} <= {1}
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


@pytest.mark.skipif(sys.platform != 'linux', reason='it reads /proc')
def test_memory_grows_with_an_array():
    before = rss_mb()
    array = np.ones(8 << 20)  # 64 MiB
    assert array.all() and 60.0 < rss_mb() - before < 80.0
    assert rss_mb() <= peak_rss_mb() and available_mb() > 0.0


def test_stopwatch_adds_durations_by_step(monkeypatch):
    times = iter([1.0, 3.0, 10.0, 10.5, 20.0, 21.0])
    monkeypatch.setattr('kfvo_ros.utils.process.time.perf_counter', lambda: next(times))
    clock = Stopwatch()
    for step in ('encode', 'decide', 'encode'):
        with clock(step):
            pass
    assert clock.durations == {'encode': 3.0, 'decide': 0.5}


def test_time_limits_grow_with_slowness_and_load(monkeypatch):
    monkeypatch.delenv(TIME_FACTOR, raising=False)
    monkeypatch.setattr(process.os, 'cpu_count', lambda: 2)
    limits = []
    for slowness, load in ((1.0, 0.0), (5.0, 0.0), (5.0, 6.0)):
        monkeypatch.setattr(process, '_slowness', lambda value=slowness: value)
        monkeypatch.setattr(process.os, 'getloadavg', lambda value=load: (value, 0.0, 0.0))
        limits.append(time_limit(10.0))
    assert limits == [10.0 * LIMIT_MARGIN * factor for factor in (1.0, 5.0, 20.0)]
    monkeypatch.setenv(TIME_FACTOR, '1.5')
    assert time_limit(10.0) == 1.5 * limits[-1]


def test_the_slowness_is_that_of_a_loop(monkeypatch):
    process._slowness.cache_clear()
    for elapsed, slowness in ((0.5, 50.0), (0.001, 1.0)):
        times = iter([1.0, 1.0 + elapsed])
        monkeypatch.setattr(process.time, 'process_time', lambda times=times: next(times))
        assert process._slowness() == pytest.approx(slowness)
        process._slowness.cache_clear()


@pytest.mark.parametrize('text', ['fast', '0', '-1', 'nan', 'inf'])
def test_a_time_factor_that_is_no_positive_number_is_an_error(monkeypatch, text):
    monkeypatch.setenv(TIME_FACTOR, text)
    with pytest.raises(KfvoError, match=f'{TIME_FACTOR}.*positive number.*{text}'):
        time_limit(1.0)
