# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A trajectory on disk while it grows: memory stays as it is, and nothing computed is lost."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.trajectory import format_tum_line

StampedPose = tuple[int, np.ndarray]
"""(stamp_ns, T_world_x (4, 4))."""


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
