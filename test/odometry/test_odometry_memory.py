# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the method holds does not grow with the sequence."""

from __future__ import annotations

import gc
import itertools
from types import ModuleType

import numpy as np
from odometry_scenes import PATTERN, RATE_NS, Scripted, frames_of

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.observations import FrameTracks
from kfvo_ros.odometry.keyframe_odometry import WINDOW_SIZE, KeyframeOdometry
from kfvo_ros.sequences.base import Frame


def to_and_fro(frames: tuple[Frame, ...]) -> itertools.chain:
    """Return the images there and back again, for ever."""
    there = [frame.image for frame in frames]
    return itertools.cycle(there + there[-2:0:-1])


def bytes_held(root: object) -> int:
    """Return the size of all arrays that can be reached from an object."""
    seen, queue, total = {id(root)}, [root], 0
    while queue:
        thing = queue.pop()
        total += thing.nbytes if isinstance(thing, np.ndarray) else 0
        for referent in gc.get_referents(thing):
            if id(referent) not in seen and not isinstance(referent, type | ModuleType):
                seen.add(id(referent))
                queue.append(referent)
    return total


def test_memory_does_not_grow_with_the_sequence():
    frames = frames_of(2, 30, width=160, height=120)
    policy = Scripted(*PATTERN * 60)
    odometry = KeyframeOdometry(GeometricBackbone(), policy)
    held, views, pending = [], [], []
    for index, image in enumerate(itertools.islice(to_and_fro(frames), 300)):
        odometry.process(Frame((index + 1) * RATE_NS, image, frames[0].camera))
        policy.seen.clear()
        if index % 20 == 19:
            gc.collect()
            held.append(bytes_held(odometry))
            views.append(sum(isinstance(thing, FrameTracks) for thing in gc.get_objects()))
            pending.append(len(odometry.pending))
    assert min(held) > 50_000  # the images and tracks of a window at least
    assert max(held[5:]) <= 1.5 * max(held[:5])
    assert max(views[5:]) <= max(views[:5]) + WINDOW_SIZE
    assert max(pending) <= 3 * WINDOW_SIZE


def test_pending_frames_are_bounded_while_keyframes_come():
    odometry = KeyframeOdometry(GeometricBackbone(), Scripted(*PATTERN * 12))
    longest = 0
    for frame in frames_of(0, 60):
        odometry.process(frame)
        longest = max(longest, len(odometry.pending))
    assert WINDOW_SIZE - 1 < longest <= 3 * WINDOW_SIZE
