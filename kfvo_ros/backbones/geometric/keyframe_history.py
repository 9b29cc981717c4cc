# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a solved window leaves to the next one of its stream."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import WindowPrior
from kfvo_ros.backbones.geometric.numba_utils import compiled
from kfvo_ros.backbones.geometric.observations import FrameTracks
from kfvo_ros.backbones.geometric.self_calibration import IntrinsicsFilter

HISTORY = 8
"""So many keyframes that left the window go on being observed, at the poses they left with.

A window of eight frames forgets what it knew of depth; these long baselines are what keeps the
scale. They are final and cost no unknowns.
"""
MAX_SHARED, LEAST_BASELINE = 0.8, 0.003
"""A keyframe joins the history when it shares fewer tracks with the one before it there, and is
so far from it in depths of the scene: hovering should not drive out what knows the scale."""
MIN_WINDOWS = 6
"""Before a plane, two motions explain two frames; so many windows from the start on tell which."""


@compiled
def count_shared(a, b):
    """Return how many numbers are both in `a` and in `b`, both increasing."""
    i, j, count = 0, 0, 0
    while i < len(a) and j < len(b):
        count += a[i] == b[j]
        i, j = i + (a[i] <= b[j]), j + (a[i] >= b[j])
    return count


@dataclass(frozen=True)
class KeyframeHistory:
    """The views of a window and its history at ``T_anchor_view``.

    ``depth`` is the median of the points'. ``measured`` says that depths were measured well at
    some time, ``unmeasured`` is the index of the last view that was placed while they were not;
    ``windows`` is how many there were in a row since the start; ``lens`` is what is known of the
    lens by then; ``trusted`` are the ids of the points whose own depths were measured well.
    """

    views: tuple[FrameTracks, ...] = ()
    T_anchor_view: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    depth: float = 1.0
    measured: bool = False
    unmeasured: int = -1
    windows: int = 0
    lens: IntrinsicsFilter = field(default_factory=IntrinsicsFilter)
    trusted: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def certain(self) -> bool:
        """Whether later windows should be held to this one."""
        return self.measured and self.windows >= MIN_WINDOWS


@dataclass(frozen=True)
class HistoryFrames:
    """Views older than the anchor, and where they are in it, in trajectory units.

    The window is ``doubted`` when it holds a view that was placed while no depths were measured.
    """

    views: tuple[FrameTracks, ...] = ()
    T_anchor_view: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    doubted: bool = False


def history_of(previous: WindowPrior | None) -> KeyframeHistory:
    """Return what the last window left; a start from nothing keeps no more than the lens."""
    if previous is None or previous.memory is None:
        return KeyframeHistory()
    return previous.memory if previous.points is not None else KeyframeHistory(lens=previous.memory.lens)


def recall(memory: KeyframeHistory, scale: float, anchor: FrameTracks) -> HistoryFrames:
    """Return the keyframes before `anchor` that the last window knew for certain.

    Keyframes that hardly differ from the one before them would only shorten the baselines.
    `scale` is trajectory units per unit of the memory.
    """
    if not memory.certain:
        return HistoryFrames()
    indices = [view.index for view in memory.views]
    if anchor.index not in indices:
        return HistoryFrames()
    position = indices.index(anchor.index)
    spaced: list[int] = []
    for older in range(position):
        if not spaced or _differ(memory, spaced[-1], older):
            spaced.append(older)
    spaced = spaced[-HISTORY:]
    T_anchor_view = geometry.relative(memory.T_anchor_view[position],
                                      memory.T_anchor_view[spaced])
    T_anchor_view[:, :3, 3] *= scale
    return HistoryFrames(tuple(memory.views[index] for index in spaced), T_anchor_view,
                         bool(spaced) and anchor.index <= memory.unmeasured)


def _differ(memory: KeyframeHistory, older: int, newer: int) -> bool:
    """Return whether the camera had moved on, and enough of the older view's tracks had ended."""
    before, after = memory.views[older].tracks.ids, memory.views[newer].tracks.ids
    way = memory.T_anchor_view[newer, :3, 3] - memory.T_anchor_view[older, :3, 3]
    return bool(math.hypot(*way) > LEAST_BASELINE * memory.depth
                and count_shared(before, after) < MAX_SHARED * len(before))
