# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Online odometry in metres: pose, motion, covariances, path and trajectory file."""

from __future__ import annotations

import errno
import io
import os
import shutil
import tempfile
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.odometry.updates import FramePose
from kfvo_ros.odometry.window_prior import scale_poses
from kfvo_ros.sequences.base import Frame
from kfvo_ros.trajectory import UNKNOWN_VARIANCE, format_tum_line
from kfvo_ros.utils.files import atomic_write

SPREAD_MEMORY = 0.05
"""Weight of the newest final pose in the mean square difference of arrival and final poses."""
MIN_VARIANCE = 1e-8
"""Lower limit of all variances: 0.1 mm and 0.1 mrad, squared."""
MAX_WAITING = 100_000
"""Poses that wait in memory for room on the disk: an hour at 30 Hz, 20 MB."""
StampedPose = tuple[int, np.ndarray]
"""(stamp_ns, T_world_x (4, 4))."""


@dataclass(frozen=True)
class OnlinePose:
    """The pose of one frame at arrival, in metres.

    ``covariance`` (6, 6) of ``T_world_camera`` (4, 4) is in world axes, translation first.
    ``T_previous_camera`` (4, 4) is the motion since the previous frame, ``interval_ns`` earlier,
    None for the first; its ``motion_covariance`` (6, 6) is in world axes too. ``intrinsics``
    K (3, 3) [px] is None unless the backbone estimates it.
    """

    stamp_ns: int
    T_world_camera: np.ndarray
    covariance: np.ndarray
    status: Status
    is_keyframe: bool
    T_previous_camera: np.ndarray | None
    interval_ns: int
    motion_covariance: np.ndarray
    intrinsics: np.ndarray | None = None


class OnlineOdometry:
    """Odometry of one uninterrupted segment; `scale` [m per unit] multiplies all output.

    Final poses are written to `log` at once; the last `path_length` are kept (None: all).
    Everything it returns is finite: a frame of which anything is not is LOST, at the last pose
    that was. ``failed_in_a_row`` counts such frames up to the present one.
    """

    def __init__(self, odometry: KeyframeOdometry, log: TrajectoryLog, scale: float = 1.0,
                 path_length: int | None = None) -> None:
        self._odometry = odometry
        self._log = log
        self._scale = scale
        self._path: deque[StampedPose] = deque(maxlen=path_length)
        self._arrivals: deque[np.ndarray] = deque()
        self._spread = np.zeros((6, 6))
        self._last: FramePose | None = None
        self._last_finite = np.eye(4)
        self.failed_in_a_row = 0

    def process(self, frame: Frame) -> OnlinePose:
        """Estimate the pose of the next frame; raises KfvoError for a frame of another size."""
        update = self._odometry.process(frame)
        self._arrivals.append(update.T_world_camera)
        self._finalise(update.final)
        previous, self._last = self._last, self._odometry.pending[-1]
        motion, interval_ns = None, 0
        if previous is not None:
            # Relative to the refined previous pose: both come from the same window.
            motion = self._metric(geometry.relative(previous.T_world_camera,
                                                    update.T_world_camera))
            interval_ns = update.stamp_ns - previous.stamp_ns
        return self._finite(OnlinePose(
            update.stamp_ns, self._metric(update.T_world_camera),
            self._metric_covariance(update.covariance), update.status, update.is_keyframe, motion,
            interval_ns, self._metric_covariance(update.window_covariance), update.intrinsics))

    def path(self) -> list[StampedPose]:
        """Return (stamp_ns, refined T_world_camera) of the latest frames."""
        path = [*self._path, *self._pending()]
        return path if self._path.maxlen is None else path[-self._path.maxlen:]

    def save(self, path: Path) -> str:
        """Write all poses so far to a new TUM file; return a report. Raises KfvoError."""
        return self._log.save(path, self._pending())

    def finish(self) -> None:
        """Write the remaining poses and close the log."""
        self._finalise(self._odometry.finish())
        self._log.close()

    def _finalise(self, final: Iterable[FramePose]) -> None:
        """Log final poses; update the spread of their differences from the poses at arrival."""
        poses = []
        for stamp_ns, T_world_camera in self._stamped(final):
            arrival = self._metric(self._arrivals.popleft())
            if not _are_finite(T_world_camera):
                self._log.missing += 1
                continue
            poses.append((stamp_ns, T_world_camera))
            if _are_finite(arrival):
                turn = geometry.log_so3(T_world_camera[:3, :3] @ arrival[:3, :3].T)
                change = np.concatenate([T_world_camera[:3, 3] - arrival[:3, 3], turn])
                self._spread += SPREAD_MEMORY * (np.outer(change, change) - self._spread)
        self._path.extend(poses)
        self._log.append(poses)

    def _pending(self) -> list[StampedPose]:
        return [pose for pose in self._stamped(self._odometry.pending) if _are_finite(pose[1])]

    def _stamped(self, poses: Iterable[FramePose]) -> list[StampedPose]:
        return [(each.stamp_ns, self._metric(each.T_world_camera)) for each in poses]

    def _finite(self, pose: OnlinePose) -> OnlinePose:
        """Return the pose if all of it is finite, else one of a LOST frame."""
        motion = pose.T_previous_camera if pose.T_previous_camera is not None else np.eye(4)
        known = _are_finite(pose.T_world_camera)
        if known:
            self._last_finite = pose.T_world_camera
            if _are_finite(pose.covariance, motion, pose.motion_covariance):
                self.failed_in_a_row = 0
                return pose
        self.failed_in_a_row += 1
        unknown = UNKNOWN_VARIANCE * np.eye(6)
        return replace(pose, T_world_camera=self._last_finite, covariance=unknown,
                       status=Status.LOST, is_keyframe=pose.is_keyframe and known,
                       T_previous_camera=None, motion_covariance=unknown, intrinsics=None)

    def _metric(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose (4, 4) of trajectory units in metres."""
        return scale_poses(pose, self._scale)

    def _metric_covariance(self, covariance: np.ndarray) -> np.ndarray:
        """Return the backbone's covariance in metres plus the spread between windows."""
        unit = np.repeat([self._scale, 1.0], 3)
        total = covariance * np.outer(unit, unit) + self._spread + MIN_VARIANCE * np.eye(6)
        return 0.5 * (total + total.T)


class TrajectoryLog:
    """A new TUM file at `path` (None: a temporary one without a name) that grows by poses.

    Poses that cannot be written, as on a full disk, wait in memory and are written once there is
    room, the oldest of more than MAX_WAITING excepted. Raises KfvoError when the file exists
    already or cannot be created; with `deferred` creation is tried again like writing.
    """

    def __init__(self, path: Path | None = None, deferred: bool = False) -> None:
        self.path = path
        self.missing = 0
        self._waiting: deque[bytes] = deque()
        self._error: KfvoError | None = None
        self._count = self._size = 0
        self._file: IO[bytes] | None = None
        if not deferred:
            self._file = _create(path)

    @property
    def problem(self) -> str:
        """Why poses are not in the file, empty where all are."""
        if self._error is not None:
            return f'{self._error}; {len(self._waiting)} poses wait in memory{self._gaps()}'
        return f'the trajectory {self._name}{self._gaps()}' if self.missing else ''

    def append(self, poses: Iterable[StampedPose]) -> None:
        """Append poses, and those that wait, as far as there is room."""
        self._waiting.extend(_lines(poses))
        try:
            if self._file is None:
                self.path = free_path(self.path) if self.path else None
                self._file = _create(self.path)
            while self._waiting:
                self._write(self._file, self._waiting[0])
                self._waiting.popleft()
                self._count += 1
            self._error = self._deletion()
        except OSError as error:
            self._error = _unwritable(self.path, error)
        except KfvoError as error:
            self._error = error
        while len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self.missing += 1

    def save(self, path: Path, rest: Iterable[StampedPose]) -> str:
        """Write the log, and poses that are not final yet, to a new file; return a report.

        The file appears when it is complete. Raises KfvoError.
        """
        lines = [*self._waiting, *_lines(rest)]
        try:
            if os.path.lexists(path):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as draft, draft.open('wb') as copy:
                self._copy_to(copy)
                copy.writelines(lines)
                copy.flush()
                os.fsync(copy.fileno())
        except (OSError, ValueError) as error:
            raise _unwritable(path, error) from error
        return f'{self._count + len(lines)} poses written to {path}{self._gaps()}'

    def close(self) -> None:
        """Close the file, after a last attempt to write what waits; an empty one is deleted."""
        if self._waiting:
            self.append(())
        if self._file is None:
            return
        try:
            self._file.close()  # where network file systems report errors
            if self.path is not None and self._count == 0:
                self.path.unlink(missing_ok=True)
        except OSError as error:
            self._error = _unwritable(self.path, error)

    @property
    def _name(self) -> Path:
        return self.path or Path(tempfile.gettempdir())

    def _gaps(self) -> str:
        return f'; {self.missing} poses are missing in it' if self.missing else ''

    def _write(self, file: IO[bytes], line: bytes) -> None:
        """Write a whole line or nothing; raises OSError."""
        try:
            written = 0
            while written < len(line):
                written += file.write(line[written:])
        except OSError:
            file.truncate(self._size)
            file.seek(self._size)
            raise
        self._size += len(line)

    def _copy_to(self, copy: IO[bytes]) -> None:
        if self._file is not None:
            self._file.seek(0)
            try:
                shutil.copyfileobj(self._file, copy)
            finally:
                self._file.seek(self._size)

    def _deletion(self) -> KfvoError | None:
        """Return the error of a file that was deleted while it grows."""
        if self.path is None or self._file is None or os.fstat(self._file.fileno()).st_nlink:
            return None
        return KfvoError(f'the trajectory {self.path} was deleted; a saved one has all poses')


def free_path(path: Path) -> Path:
    """Return `path`, or the first of path-1, path-2 ... that does not exist."""
    candidate, number = path, 0
    while os.path.lexists(candidate):
        number += 1
        candidate = path.with_stem(f'{path.stem}-{number}')
    return candidate


def _are_finite(*arrays: np.ndarray) -> bool:
    return all(np.isfinite(array).all() for array in arrays)


def _lines(poses: Iterable[StampedPose]) -> list[bytes]:
    return [format_tum_line(*pose).encode('ascii') for pose in poses]


def _create(path: Path | None) -> IO[bytes]:
    """Return a new file without a buffer, in which errors of writing would hide."""
    if path is None:
        try:
            return tempfile.TemporaryFile(buffering=0)
        except OSError:  # no folder for temporary files, as in read-only containers
            return io.BytesIO()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open('xb+', buffering=0)
    except (OSError, ValueError) as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path | None, error: Exception) -> KfvoError:
    return KfvoError(f'cannot write the trajectory {path or tempfile.gettempdir()}: '
                     f'{reason_of(error)}')
