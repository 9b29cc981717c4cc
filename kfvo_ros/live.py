# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry of a running camera: each frame's pose, motion and doubt in metres, and the path."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.knowledge import scaled
from kfvo_ros.odometry import KeyframeOdometry, Placed
from kfvo_ros.sequences.base import Frame
from kfvo_ros.trajectory_log import TrajectoryLog

SPREAD_MEMORY = 0.05
"""Weight of the newest final pose in the spread of arrival against final poses."""
LEAST_VARIANCE = 1e-8
"""No pose is believed better than a tenth of a millimetre and of a milliradian."""


@dataclass(frozen=True)
class LivePose:
    """One frame at its arrival, in metres.

    ``T_world_camera`` (4, 4) with its ``covariance`` (6, 6) in the axes of the world,
    translation first; ``T_before_camera`` (4, 4) the motion since the frame before, which was
    ``interval_ns`` ago, with ``motion_covariance`` (6, 6) in the same axes; None for the first.
    ``intrinsics`` K (3, 3) [px] where the backbone estimates them.
    """

    stamp_ns: int
    T_world_camera: np.ndarray
    covariance: np.ndarray
    status: Status
    is_keyframe: bool
    T_before_camera: np.ndarray | None
    interval_ns: int
    motion_covariance: np.ndarray
    intrinsics: np.ndarray | None = None


class LiveOdometry:
    """Runs one uninterrupted segment; `scale` [m per unit] multiplies all that comes out.

    Final poses go to `log` at once; the last `path_length` of them, None for all, are kept.
    """

    def __init__(self, odometry: KeyframeOdometry, log: TrajectoryLog, scale: float = 1.0,
                 path_length: int | None = None) -> None:
        self._odometry = odometry
        self._log = log
        self._scale = scale
        self._path: deque[tuple[int, np.ndarray]] = deque(maxlen=path_length)
        self._arrivals: deque[np.ndarray] = deque()
        self._spread = np.zeros((6, 6))
        self._last: Placed | None = None

    def process(self, frame: Frame) -> LivePose:
        """Take in the next frame; raises KfvoError when the frame does not fit the camera."""
        update = self._odometry.process(frame)
        self._arrivals.append(update.T_world_camera)
        self._finalise(update.final)
        before, self._last = self._last, self._odometry.pending[-1]
        motion, interval_ns = None, 0
        if before is not None:
            # Against the frame before as it is seen now: one window made both.
            motion = self._metric(geometry.relative(before.T_world_camera,
                                                    update.T_world_camera))
            interval_ns = update.stamp_ns - before.stamp_ns
        return LivePose(update.stamp_ns, self._metric(update.T_world_camera),
                        self._doubt(update.covariance), update.status, update.is_keyframe,
                        motion, interval_ns, self._doubt(update.window_covariance),
                        update.intrinsics)

    def path(self) -> list[tuple[int, np.ndarray]]:
        """Return (stamp_ns, T_world_camera) of the latest frames as they are refined by now."""
        pending = [(placed.stamp_ns, self._metric(placed.T_world_camera))
                   for placed in self._odometry.pending]
        path = [*self._path, *pending]
        return path if self._path.maxlen is None else path[-self._path.maxlen:]

    def save(self, path: Path) -> int:
        """Write all poses so far to a new TUM file; return how many. Raises KfvoError."""
        return self._log.save(path, self._lines(self._odometry.pending))

    def finish(self) -> None:
        """Complete the log: no frame follows."""
        self._finalise(self._odometry.finish())
        self._log.close()

    def _finalise(self, final: Iterable[Placed]) -> None:
        """Log final poses and learn from them how far off the estimates at arrival were."""
        lines = self._lines(final)
        for _, T_world_camera in lines:
            arrival = self._metric(self._arrivals.popleft())
            turn = geometry.log_so3(T_world_camera[:3, :3] @ arrival[:3, :3].T)
            change = np.concatenate([T_world_camera[:3, 3] - arrival[:3, 3], turn])
            self._spread += SPREAD_MEMORY * (np.outer(change, change) - self._spread)
        self._path.extend(lines)
        self._log.append(lines)

    def _lines(self, placed: Iterable[Placed]) -> list[tuple[int, np.ndarray]]:
        return [(each.stamp_ns, self._metric(each.T_world_camera)) for each in placed]

    def _metric(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose (4, 4) of trajectory units in metres."""
        return scaled(pose, self._scale)

    def _doubt(self, covariance: np.ndarray) -> np.ndarray:
        """Return what the backbone doubts, in metres, and what windows disagree on."""
        unit = np.repeat([self._scale, 1.0], 3)
        total = covariance * np.outer(unit, unit) + self._spread + LEAST_VARIANCE * np.eye(6)
        return 0.5 * (total + total.T)
