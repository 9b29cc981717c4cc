# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The times in summary.json: median and 95th percentile of steps, of their sum, and of parts."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros.backbones.base import Status
from kfvo_ros.evaluation.results import ResultWriter
from kfvo_ros.odometry.updates import Update


def took(encode: float, estimate: float, head: float) -> Update:
    """Return what a frame told that took so long [s], the head as a part of estimating."""
    return Update(0, np.eye(4), np.eye(6), np.eye(6), Status.OK, True, (), None,
                  {'encode': encode, 'estimate': estimate}, None, {'head': head})


def test_a_part_is_told_and_not_counted_twice(tmp_path):
    writer = ResultWriter(tmp_path)
    # The frame that encodes longest is not the one that estimates longest: percentiles of the
    # steps do not add up to those of the sum.
    for encode, estimate, head in ((0.001, 0.020, 0.010), (0.002, 0.040, 0.030),
                                   (0.008, 0.010, 0.005)):
        writer.update(took(encode, estimate, head))
    times = writer.finish({}, None)['ms_per_frame']
    assert set(times) == {'encode', 'estimate', 'total', 'head'}
    assert {step: each['median'] for step, each in times.items()} == pytest.approx(
        {'encode': 2.0, 'estimate': 20.0, 'total': 21.0, 'head': 10.0})
    assert {step: each['p95'] for step, each in times.items()} == pytest.approx(
        {'encode': 7.4, 'estimate': 38.0, 'total': 39.9, 'head': 28.0})
