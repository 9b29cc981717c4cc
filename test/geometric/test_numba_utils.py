# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test compiled medians against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros.backbones.geometric import numba_utils


@pytest.mark.parametrize('count', range(1, 12))
def test_median_equals_numpy(count):
    rng = np.random.default_rng(count)
    for values in (rng.normal(size=count), rng.integers(0, 4, count).astype(np.float64)):
        before = values.copy()
        assert numba_utils.median(values) == np.median(values)
        assert np.array_equal(values, before)


@pytest.mark.parametrize('values', [[np.inf] * 4, [1.0, np.inf, np.inf, np.inf, 2.0], [0.0] * 5000,
                                    [-np.inf, 1.0, -np.inf, 1.0, 1.0]])
def test_median_terminates_with_ties_and_infinities(values):
    assert numba_utils.median(np.array(values)) == np.median(values)


def test_median_of_nan_is_nan():
    assert np.isnan(numba_utils.median(np.full(5, np.nan)))


@pytest.mark.parametrize('share', [0.0, 0.3, 1.0])
def test_median_where_equals_numpy(share):
    rng = np.random.default_rng(3)
    values, mask = rng.random((6, 25)), rng.random((6, 25)) < share
    typical, count = numba_utils.median_where(values, mask)
    assert count == mask.sum()
    assert typical == (np.median(values[mask]) if count else 0.0)


def test_medians_of_nearest_equal_numpy():
    rng = np.random.default_rng(2)
    queries, points, values = rng.random((9, 2)), rng.random((40, 2)), rng.random(40)
    distances = np.linalg.norm(queries[:, None] - points, axis=2)
    expected = np.median(values[np.argsort(distances, axis=1)[:, :5]], axis=1)
    assert np.array_equal(numba_utils.medians_of_nearest(queries, points, values, 5), expected)
