# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a window of the geometric backbone leaves to the next one."""

from __future__ import annotations

import pytest
from odometry_scenes import moving_poses, turning_poses, window

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone


@pytest.mark.parametrize(('poses', 'noise', 'measured'), [
    (moving_poses(8, 0.02), 0.3, True), (moving_poses(8, 0.02), 1.0, False),
    (moving_poses(8, 0.25), 1.0, True), (turning_poses(8), 0.3, False)])
def test_noise_does_not_pass_for_a_measurement(poses, noise, measured):
    """Depths are known by how far the camera moved, and by how far the tracks are off."""
    for seed in range(3):
        seen = window(poses, seed, noise)
        memory = GeometricBackbone().estimate([seen])[0].memory
        assert memory.measured == measured
        assert (len(memory.trusted) > 0.5 * len(seen.frames[0].tracks)) == measured
