# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What two frames have in common."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros.tracking.tracker import present, shared


@pytest.mark.parametrize('seed', range(5))
def test_shared_ids_are_found_in_both(seed):
    rng = np.random.default_rng(seed)
    a, b = (np.flatnonzero(rng.random(60) < share) + 7 for share in (0.3, 0.7))
    in_a, in_b = shared(a, b)
    assert np.array_equal(a[in_a], b[in_b])
    assert set(a[in_a]) == set(a) & set(b)
    assert np.array_equal(present(a, b), np.isin(a, b))


def test_nothing_is_shared_with_nothing():
    some, none = np.array([3, 5]), np.zeros(0, dtype=np.int64)
    for a, b in ((some, none), (none, some), (none, none), (some, some + 10), (some + 10, some)):
        assert all(len(indices) == 0 for indices in shared(a, b))
        assert len(present(a, b)) == len(a) and not present(a, b).any()
