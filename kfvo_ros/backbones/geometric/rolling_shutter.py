# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rolling shutter correction: track positions as if all rows were read with the middle one.

A row that is read dt after the middle one observes its points dt later. To first order a point is
moved back by its image velocity times dt. Without the correction bundle adjustment explains the
effect by depth and translation, most of all where the camera turns.

A frame's readout ends before that of the next one begins. Closer stamps come from a busy computer,
so velocities are computed over at least one readout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.tracking import motion_field, tracker
from kfvo_ros.tracking.motion_field import MotionField
from kfvo_ros.tracking.tracker import Tracks
from kfvo_ros.trajectory import NANOSECONDS

MAX_GAP_NS = 200_000_000
"""Velocities over a longer gap between frames do not apply to the time of the readout."""


@dataclass
class RollingShutter:
    """Corrects the frames of one stream, in order; does nothing for a global shutter."""

    camera: Camera
    _last: tuple[int, Tracks] | None = None
    _last_field: MotionField | None = None

    def correct(self, stamp_ns: int, tracks: Tracks) -> np.ndarray:
        """Return pixels (N, 2) at the time of the middle row."""
        if self.camera.readout_s == 0.0:
            return tracks.pixels
        last, self._last = self._last, (stamp_ns, tracks)
        last_field, self._last_field = self._last_field, None
        if last is None or not 0 < stamp_ns - last[0] <= MAX_GAP_NS:
            return tracks.pixels
        now, before = tracker.match_ids(tracks.ids, last[1].ids)
        motion = tracks.pixels[now] - last[1].pixels[before]
        # A point that moved down was read later in its frame, so it had more time to move.
        rows_s = self.camera.readout_s * motion[:, 1:] / self.camera.height
        gap_s = max((stamp_ns - last[0]) / NANOSECONDS, self.camera.readout_s)
        measured = motion / (gap_s + rows_s)
        size = np.array([self.camera.width, self.camera.height])
        field = self._last_field = motion_field.fit(tracks.pixels[now], measured, size)
        if field is None:
            return tracks.pixels
        velocities = field.at(tracks.pixels)
        velocities[now] = measured
        # The difference of two frames is the velocity half a frame ago: extrapolate it.
        if last_field is not None:
            velocities += 0.5 * (field.at(tracks.pixels) - last_field.at(tracks.pixels))
        delay = self.camera.readout_s * ((tracks.pixels[:, 1] + 0.5) / self.camera.height - 0.5)
        return tracks.pixels - velocities * delay[:, None]
