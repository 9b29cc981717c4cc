# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Memory of the odometry does not grow with the sequence."""

from __future__ import annotations

import gc
import itertools
from types import ModuleType

import numpy as np
from odometry_scenes import PATTERN, RATE_NS, ScriptedPolicy, frames_of

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.observations import FrameTracks
from kfvo_ros.odometry.keyframe_odometry import WINDOW_SIZE, KeyframeOdometry
from kfvo_ros.sequences.base import Frame


def forward_and_backward(frames: tuple[Frame, ...]) -> itertools.cycle:
    """Return the images forward and backward, endlessly."""
    images = [frame.image for frame in frames]
    return itertools.cycle(images + images[-2:0:-1])


def array_bytes(root: object) -> int:
    """Return the size of all arrays that can be reached from an object."""
    visited, queue, total = {id(root)}, [root], 0
    while queue:
        each = queue.pop()
        total += each.nbytes if isinstance(each, np.ndarray) else 0
        for referent in gc.get_referents(each):
            if id(referent) not in visited and not isinstance(referent, type | ModuleType):
                visited.add(id(referent))
                queue.append(referent)
    return total


def test_memory_does_not_grow_with_the_sequence():
    frames = frames_of(2, 30, width=160, height=120)
    policy = ScriptedPolicy(*PATTERN * 60)
    odometry = KeyframeOdometry(GeometricBackbone(), policy)
    sizes, track_counts, pending = [], [], []
    for index, image in enumerate(itertools.islice(forward_and_backward(frames), 300)):
        odometry.process(Frame((index + 1) * RATE_NS, image, frames[0].camera))
        policy.inputs.clear()
        if index % 20 == 19:
            gc.collect()
            sizes.append(array_bytes(odometry))
            track_counts.append(sum(isinstance(each, FrameTracks) for each in gc.get_objects()))
            pending.append(len(odometry.pending))
    assert min(sizes) > 50_000  # at least the images and tracks of a window
    assert max(sizes[5:]) <= 1.5 * max(sizes[:5])
    assert max(track_counts[5:]) <= max(track_counts[:5]) + WINDOW_SIZE
    assert max(pending) <= 3 * WINDOW_SIZE


def test_pending_frames_are_bounded():
    odometry = KeyframeOdometry(GeometricBackbone(), ScriptedPolicy(*PATTERN * 12))
    longest = 0
    for frame in frames_of(0, 60):
        odometry.process(frame)
        longest = max(longest, len(odometry.pending))
    assert WINDOW_SIZE - 1 < longest <= 3 * WINDOW_SIZE
