# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Take the rolling shutter out of tracks: where each would be if all rows were read at once.

A row read dt after the middle one sees its points dt later, so a point is moved back by its
image velocity times dt. To first order that is the whole effect; left in, it looks like depth and
translation to a bundle adjustment, and a turning camera is what suffers most.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.tracking import Tracks
from kfvo_ros.trajectory import NANOSECONDS

MIN_TRACKS = 24
"""With fewer tracks the motion field is not fitted, and nothing is corrected."""
MAX_GAP_NS = 200_000_000
"""Velocities over a longer gap between frames say nothing of the moment of the readout."""


@dataclass
class RollingShutter:
    """Corrects the frames of one stream, in order; does nothing for a global shutter."""

    camera: Camera
    _last: tuple[int, Tracks] | None = None
    _last_field: np.ndarray | None = field(default=None)

    def correct(self, stamp_ns: int, tracks: Tracks) -> np.ndarray:
        """Return pixels (N, 2) as the middle row's moment saw them."""
        if self.camera.readout_s == 0.0:
            return tracks.pixels
        last, self._last = self._last, (stamp_ns, tracks)
        if last is None or not 0 < stamp_ns - last[0] <= MAX_GAP_NS:
            self._last_field = None
            return tracks.pixels
        _, now, before = np.intersect1d(tracks.ids, last[1].ids, assume_unique=True,
                                        return_indices=True)
        if len(now) < MIN_TRACKS:
            self._last_field = None
            return tracks.pixels
        motion = tracks.pixels[now] - last[1].pixels[before]
        # A point that moved down was read later in its frame, so it had more time to move.
        rows_s = self.camera.readout_s * motion[:, 1:] / self.camera.height
        measured = motion / ((stamp_ns - last[0]) / NANOSECONDS + rows_s)
        basis = self._basis(tracks.pixels)
        motion_field = _fit_robustly(basis[now], measured)
        velocities = basis @ motion_field
        velocities[now] = measured
        # A difference of frames is the velocity half a frame ago: carry it to this frame.
        if self._last_field is not None:
            velocities += 0.5 * basis @ (motion_field - self._last_field)
        self._last_field = motion_field
        delay = self.camera.readout_s * ((tracks.pixels[:, 1] + 0.5) / self.camera.height - 0.5)
        return tracks.pixels - velocities * delay[:, None]

    def _basis(self, pixels: np.ndarray) -> np.ndarray:
        """Return (N, 6) the monomials to second order: a rotation's flow is one of them."""
        x, y = (pixels - (self.camera.cx, self.camera.cy)).T / self.camera.width
        return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])


def _fit_robustly(basis: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the coefficients (6, 2) of least squares, once more without the worst fifth."""
    coefficients = np.linalg.lstsq(basis, values, rcond=None)[0]
    errors = np.linalg.norm(values - basis @ coefficients, axis=1)
    kept = errors <= np.quantile(errors, 0.8)
    return np.linalg.lstsq(basis[kept], values[kept], rcond=None)[0]
