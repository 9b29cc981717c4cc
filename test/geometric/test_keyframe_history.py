# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test the memory that a window leaves to the next one."""

from __future__ import annotations

import numpy as np
import pytest
from odometry_scenes import moving_poses, turning_poses, window

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.keyframe_history import count_shared


@pytest.mark.parametrize(('poses', 'noise', 'measured'), [
    (moving_poses(8, 0.02), 0.3, True), (moving_poses(8, 0.02), 1.0, False),
    (moving_poses(8, 0.25), 1.0, True), (turning_poses(8), 0.3, False)])
def test_depths_are_measured_by_parallax_and_not_by_noise(poses, noise, measured):
    for seed in range(3):
        noisy = window(poses, seed, noise)
        memory = GeometricBackbone().estimate([noisy])[0].memory
        assert memory.measured == measured
        assert (len(memory.trusted_ids) > 0.5 * len(noisy.frames[0].tracks)) == measured


@pytest.mark.parametrize('sizes', [(0, 3), (7, 0), (30, 12), (12, 30)])
def test_count_shared_equals_numpy(sizes):
    rng = np.random.default_rng(4)
    a, b = (np.sort(rng.choice(40, size, replace=False)) for size in sizes)
    assert count_shared(a, b) == len(np.intersect1d(a, b))
