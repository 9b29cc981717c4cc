# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Online odometry in metres: pose, motion, covariances, path and trajectory file."""

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
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.odometry.updates import FramePose
from kfvo_ros.odometry.window_prior import scale_poses
from kfvo_ros.sequences.base import Frame
from kfvo_ros.trajectory import format_tum_line

SPREAD_MEMORY = 0.05
"""Weight of the newest final pose in the mean square difference of arrival and final poses."""
MIN_VARIANCE = 1e-8
"""Lower limit of all variances: 0.1 mm and 0.1 mrad, squared."""
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
        return OnlinePose(update.stamp_ns, self._metric(update.T_world_camera),
                          self._metric_covariance(update.covariance), update.status,
                          update.is_keyframe, motion, interval_ns,
                          self._metric_covariance(update.window_covariance),
                          update.intrinsics)

    def path(self) -> list[StampedPose]:
        """Return (stamp_ns, refined T_world_camera) of the latest frames."""
        path = [*self._path, *self._stamped(self._odometry.pending)]
        return path if self._path.maxlen is None else path[-self._path.maxlen:]

    def save(self, path: Path) -> int:
        """Write all poses so far to a new TUM file; return their number. Raises KfvoError."""
        return self._log.save(path, self._stamped(self._odometry.pending))

    def finish(self) -> None:
        """Write the remaining poses and close the log."""
        self._finalise(self._odometry.finish())
        self._log.close()

    def _finalise(self, final: Iterable[FramePose]) -> None:
        """Log final poses; update the spread of their differences from the poses at arrival."""
        poses = self._stamped(final)
        for _, T_world_camera in poses:
            arrival = self._metric(self._arrivals.popleft())
            turn = geometry.log_so3(T_world_camera[:3, :3] @ arrival[:3, :3].T)
            change = np.concatenate([T_world_camera[:3, 3] - arrival[:3, 3], turn])
            self._spread += SPREAD_MEMORY * (np.outer(change, change) - self._spread)
        self._path.extend(poses)
        self._log.append(poses)

    def _stamped(self, poses: Iterable[FramePose]) -> list[StampedPose]:
        return [(each.stamp_ns, self._metric(each.T_world_camera)) for each in poses]

    def _metric(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose (4, 4) of trajectory units in metres."""
        return scale_poses(pose, self._scale)

    def _metric_covariance(self, covariance: np.ndarray) -> np.ndarray:
        """Return the backbone's covariance in metres plus the spread between windows."""
        unit = np.repeat([self._scale, 1.0], 3)
        total = covariance * np.outer(unit, unit) + self._spread + MIN_VARIANCE * np.eye(6)
        return 0.5 * (total + total.T)


class TrajectoryLog:
    """A new TUM file at `path` (None: an unnamed temporary file) to which poses are appended.

    Raises KfvoError when the file exists already or cannot be created. When a later write fails,
    ``problem`` holds the error and nothing more is written.
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
        """Append poses and flush them to disk."""
        if self.problem is None:
            lines = [format_tum_line(*pose) for pose in poses]
            with self._writing_errors():
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
        """Close the file; an empty one is deleted."""
        with self._writing_errors():
            self._file.close()  # flushes, which fails again where the disk is full
        if self.path is not None and self._count == 0:
            self.path.unlink(missing_ok=True)

    @contextmanager
    def _writing_errors(self) -> Iterator[None]:
        """Store a write error in ``problem``: a full disk must not end the odometry."""
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
