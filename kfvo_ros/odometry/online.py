# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry of a running camera: each frame's pose, motion and doubt in metres, and the path."""

from __future__ import annotations

import shutil
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.odometry.keyframe_odometry import FramePose, KeyframeOdometry
from kfvo_ros.odometry.window_prior import scale_poses
from kfvo_ros.sequences.base import Frame
from kfvo_ros.trajectory import format_tum_line

SPREAD_MEMORY = 0.05
"""Weight of the newest final pose in the spread of arrival against final poses."""
LEAST_VARIANCE = 1e-8
"""No pose is believed better than a tenth of a millimetre and of a milliradian."""
StampedPose = tuple[int, np.ndarray]
"""(stamp_ns, T_world_x (4, 4))."""


@dataclass(frozen=True)
class OnlinePose:
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


class OnlineOdometry:
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
        self._last: FramePose | None = None

    def process(self, frame: Frame) -> OnlinePose:
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
        return OnlinePose(update.stamp_ns, self._metric(update.T_world_camera),
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

    def _finalise(self, final: Iterable[FramePose]) -> None:
        """Log final poses and learn from them how far off the estimates at arrival were."""
        lines = self._lines(final)
        for _, T_world_camera in lines:
            arrival = self._metric(self._arrivals.popleft())
            turn = geometry.log_so3(T_world_camera[:3, :3] @ arrival[:3, :3].T)
            change = np.concatenate([T_world_camera[:3, 3] - arrival[:3, 3], turn])
            self._spread += SPREAD_MEMORY * (np.outer(change, change) - self._spread)
        self._path.extend(lines)
        self._log.append(lines)

    def _lines(self, placed: Iterable[FramePose]) -> list[tuple[int, np.ndarray]]:
        return [(each.stamp_ns, self._metric(each.T_world_camera)) for each in placed]

    def _metric(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose (4, 4) of trajectory units in metres."""
        return scale_poses(pose, self._scale)

    def _doubt(self, covariance: np.ndarray) -> np.ndarray:
        """Return what the backbone doubts, in metres, and what windows disagree on."""
        unit = np.repeat([self._scale, 1.0], 3)
        total = covariance * np.outer(unit, unit) + self._spread + LEAST_VARIANCE * np.eye(6)
        return 0.5 * (total + total.T)


class TrajectoryLog:
    """Appends final poses to a new TUM file at `path`, or to a nameless temporary one.

    ``path`` is None for the latter. Raises KfvoError when the file exists already or cannot be
    written; when a later write fails, ``problem`` tells and no more is written.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self.problem: KfvoError | None = None
        self._count = 0
        self._file: TextIO
        if path is None:
            self._file = tempfile.TemporaryFile('w+', encoding='ascii')  # noqa: SIM115
        else:
            self._file = _create(path)

    def append(self, poses: Iterable[StampedPose]) -> None:
        """Append poses, and see to it that they are on disk."""
        if self.problem is None:
            lines = [format_tum_line(*pose) for pose in poses]
            with self._told():
                self._file.writelines(lines)
                self._file.flush()
                self._count += len(lines)

    def save(self, path: Path, rest: Iterable[StampedPose]) -> int:
        """Copy the log, and poses that are not final yet, to a new file; return their number."""
        copy = _create(path)
        lines = [format_tum_line(*pose) for pose in rest]
        try:
            with copy:
                self._file.seek(0)
                shutil.copyfileobj(self._file, copy)
                copy.writelines(lines)
            return self._count + len(lines)
        except OSError as error:
            raise _unwritable(path, error) from error
        finally:
            self._file.seek(0, 2)

    def close(self) -> None:
        """Close the file; an empty one is not left behind."""
        with self._told():
            self._file.close()  # where the disk is full, what it still holds fails again
        if self.path is not None and self._count == 0:
            self.path.unlink(missing_ok=True)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Keep a failure to write as the problem: a full disk must not end an odometry."""
        try:
            yield
        except OSError as error:
            self.problem = _unwritable(self.path or Path(tempfile.gettempdir()), error)


def free_path(path: Path) -> Path:
    """Return `path`, or the first of path-1, path-2 ... that does not exist."""
    candidate, number = path, 0
    while candidate.exists():
        number += 1
        candidate = path.with_stem(f'{path.stem}-{number}')
    return candidate


def _create(path: Path) -> TextIO:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open('x+', encoding='ascii')
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> KfvoError:
    return KfvoError(f'cannot write the trajectory {path}: {reason_of(error)}')
