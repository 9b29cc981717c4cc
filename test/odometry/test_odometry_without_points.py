# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry with a backbone like VGGT: no points, no tracks, each window in its own unit."""

from __future__ import annotations

from functools import partial

import numpy as np
from odometry_scenes import RATE_NS, frames_of, restamped, run

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Backbone, Encoded, Estimate, Stream
from kfvo_ros.keyframes.heuristics import EveryFrame, Survival
from kfvo_ros.odometry.keyframe_odometry import WINDOW_SIZE
from kfvo_ros.sequences.base import Frame


class PosesOnlyBackbone(Backbone):
    """A backbone without points, tracks or memory, that knows the true pose of each stamp."""

    name = 'poses_only'
    descriptor_size = 1

    def __init__(self, unit: float) -> None:
        self.unit = unit
        self.released: list[int] = []
        self.opened = 0

    def open(self, camera):
        backbone = self
        self.opened += 1

        class PosesOnlyStream(Stream):
            def encode(self, frame):
                return Encoded(frame.stamp_ns, np.ones(1, dtype=np.float32))

            def release(self, encoded):
                backbone.released.append(encoded.stamp_ns)
        return PosesOnlyStream()

    def estimate(self, windows):
        result = []
        for window in windows:
            world = np.stack([self.pose(frame.stamp_ns) for frame in window.frames])
            poses = geometry.relative(world[0], world)
            poses[:, :3, 3] /= self.unit * (1.0 + 0.5 * np.sin(window.frames[0].stamp_ns))
            poses[0] = np.eye(4)
            result.append(Estimate(poses, partial(np.zeros, (len(poses), 6, 6)), None,
                                   np.zeros(0, dtype=np.float32), memory='anything'))
        return result

    @staticmethod
    def pose(stamp_ns: int) -> np.ndarray:
        along = stamp_ns / RATE_NS - 1.0
        return geometry.make_transform(geometry.exp_so3(np.array([0.0, 0.02, 0.01]) * along),
                                       [along, np.sin(0.3 * along), 0.2 * along])


def frames_by_stamp(count: int) -> list[Frame]:
    """Return frames whose stamps PosesOnlyBackbone maps to poses."""
    frames = frames_of(0, 60)
    return restamped([frame.image for frame in frames[:count]], frames[0].camera)


def test_backbone_without_points_or_tracks():
    """As of VGGT: each window has its own unit, and only the policy needs the tracker."""
    backbone = PosesOnlyBackbone(3.0)
    frames = frames_by_stamp(40)
    result = run(frames, Survival(), backbone)
    truth = np.stack([PosesOnlyBackbone.pose(frame.stamp_ns) for frame in frames])
    fit = geometry.umeyama(result.poses[:, :3, 3], truth[:, :3, 3])
    np.testing.assert_allclose(fit.transform_points(result.poses[:, :3, 3]), truth[:, :3, 3],
                               atol=1e-6)
    assert backbone.opened == 1
    assert all(update.median_depth is None for update in result.updates)
    # Frames that left the window are released once, those in the window are not.
    dropped = [update.stamp_ns for update in result.updates if not update.is_keyframe]
    kept = [update.stamp_ns for update in result.updates if update.is_keyframe]
    assert 0 < len(dropped) < 33
    assert sorted(backbone.released) == sorted(dropped + kept[:-(WINDOW_SIZE - 1)])


def test_scale_rule_none_keeps_the_unit_of_each_window():
    frames = frames_by_stamp(20)
    unaligned = run(frames, EveryFrame(), PosesOnlyBackbone(3.0), scale_rule='none')
    aligned = run(frames, EveryFrame(), PosesOnlyBackbone(3.0))
    truth = np.stack([PosesOnlyBackbone.pose(frame.stamp_ns) for frame in frames])[:, :3, 3]

    def misfit(result):
        positions = result.poses[:, :3, 3]
        fitted = geometry.umeyama(positions, truth).transform_points(positions)
        return np.abs(fitted - truth).max()

    assert misfit(aligned) < 1e-6 < 0.1 < misfit(unaligned)
