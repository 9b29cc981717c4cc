# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""State from one window of a stream to the next: solved frames, and keyframes before the anchor.

Keyframes that left the window stay in the next problems as constant frames. Their long baselines
keep the scale, which a window of eight frames alone forgets, and add no unknowns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import int64

from kfvo_ros import geometry
from kfvo_ros.backbones.base import WindowPrior
from kfvo_ros.backbones.geometric.numba_utils import entry_point
from kfvo_ros.backbones.geometric.observations import FrameTracks
from kfvo_ros.backbones.geometric.self_calibration import IntrinsicsFilter

MAX_HISTORY = 8
"""Number of keyframes before the anchor."""
MAX_OVERLAP, MIN_BASELINE = 0.8, 0.003
"""A keyframe is added to the history when it shares less than this part of the last one's tracks
and is at least this far from it, in depths of the scene: hovering must not displace long
baselines."""
MIN_WINDOWS = 6
"""Two motions explain two frames before a plane; this number of windows resolves it."""


@dataclass(frozen=True)
class KeyframeHistory:
    """Memory of a stream after a window: its frames and their history.

    ``T_anchor_frame`` (F, 4, 4) are the poses of ``frames`` and ``median_depth`` that of the
    points. ``measured`` says whether depths were once measured well; ``last_unmeasured`` is the
    index of the last frame placed without that; ``windows`` counts windows since the start;
    ``trusted_ids`` are those of points whose depths were measured well.
    """

    frames: tuple[FrameTracks, ...] = ()
    T_anchor_frame: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    median_depth: float = 1.0
    measured: bool = False
    last_unmeasured: int = -1
    windows: int = 0
    intrinsics_filter: IntrinsicsFilter = field(default_factory=IntrinsicsFilter)
    trusted_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def initialised(self) -> bool:
        """Whether later windows are constrained by this one."""
        return self.measured and self.windows >= MIN_WINDOWS


@dataclass(frozen=True)
class HistoryFrames:
    """Frames before the anchor and their poses (H, 4, 4) in it, in trajectory units.

    ``has_unmeasured`` says whether the window has a frame that was placed while no depths were
    measured well.
    """

    frames: tuple[FrameTracks, ...] = ()
    T_anchor_frame: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    has_unmeasured: bool = False


def history_of(prior: WindowPrior | None) -> KeyframeHistory:
    """Return the last window's memory; only the intrinsics survive where points are lost."""
    if prior is None or prior.memory is None:
        return KeyframeHistory()
    memory: KeyframeHistory = prior.memory
    if prior.points is None:
        return KeyframeHistory(intrinsics_filter=memory.intrinsics_filter)
    return memory


def select_history(memory: KeyframeHistory, scale: float, anchor: FrameTracks) -> HistoryFrames:
    """Return the last well-spaced frames before `anchor`, empty until initialised.

    `scale` is trajectory units per unit of the memory.
    """
    if not memory.initialised:
        return HistoryFrames()
    indices = [frame.index for frame in memory.frames]
    if anchor.index not in indices:
        return HistoryFrames()
    position = indices.index(anchor.index)
    spaced: list[int] = []
    for older in range(position):
        if not spaced or _well_spaced(memory, spaced[-1], older):
            spaced.append(older)
    spaced = spaced[-MAX_HISTORY:]
    T_anchor_frame = geometry.relative(memory.T_anchor_frame[position],
                                       memory.T_anchor_frame[spaced])
    T_anchor_frame[:, :3, 3] *= scale
    return HistoryFrames(tuple(memory.frames[index] for index in spaced), T_anchor_frame,
                         bool(spaced) and anchor.index <= memory.last_unmeasured)


def _well_spaced(memory: KeyframeHistory, older: int, newer: int) -> bool:
    """Return whether two frames are far enough apart and share few enough tracks."""
    before, after = memory.frames[older].tracks.ids, memory.frames[newer].tracks.ids
    baseline = memory.T_anchor_frame[newer, :3, 3] - memory.T_anchor_frame[older, :3, 3]
    return bool(math.hypot(*baseline) > MIN_BASELINE * memory.median_depth
                and count_shared(before, after) < MAX_OVERLAP * len(before))


@entry_point(int64[::1], int64[::1])
def count_shared(a: np.ndarray, b: np.ndarray) -> int:
    """Return the number of common elements of `a` and `b`, both increasing."""
    i, j, count = 0, 0, 0
    while i < len(a) and j < len(b):
        count += a[i] == b[j]
        i, j = i + (a[i] <= b[j]), j + (a[i] >= b[j])
    return count
