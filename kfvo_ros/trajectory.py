# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamped poses, and their TUM and KITTI files.

A stamp is an int of nanoseconds. Decimal text becomes nanoseconds without a float in between,
because a float64 of a present-day epoch resolves only 0.2 microseconds.
"""

from __future__ import annotations

import logging
import math
import re
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.files import parse_floats, parse_pose, read_lines, read_rows

NANOSECONDS = 1_000_000_000
ASSOCIATION_LIMIT_NS = 10_000_000
"""Largest time difference of a frame and its ground truth (10 ms)."""
UNKNOWN_VARIANCE = 9999.0
"""Variance of an unmeasured velocity, rtabmap's value; zero would mean exact."""
MAX_POSITION = 1e9
"""Largest coordinate of a credible pose [m]: more than any of the Earth, and no overflow."""
_log = logging.getLogger(__name__)
_DECIMAL = re.compile(r'([+-]?)([0-9]*)\.?([0-9]*)(?:[eE]([+-]?[0-9]{1,3}))?')


def parse_stamp_ns(text: str) -> int:
    """Return nanoseconds of decimal seconds, exact to the ninth decimal (the rest is truncated).

    Exponents, which KITTI's times.txt uses, are accepted. Raises ValueError for other text and
    for times beyond 64 bits of nanoseconds (292 years).
    """
    return _parse_decimal(text, 9)


def parse_nanoseconds(text: str) -> int:
    """Return whole nanoseconds of decimal nanoseconds; ValueError as `parse_stamp_ns`."""
    return _parse_decimal(text, 0)


def _parse_decimal(text: str, decimals: int) -> int:
    """Return the decimal number times 10 ** `decimals`, truncated."""
    match = _DECIMAL.fullmatch(text.strip())
    if match is None or not match[2] + match[3]:
        raise ValueError(f'not a decimal number of time: {text!r}')
    sign, whole, fraction, exponent = match.groups()
    digits, shift = int(whole + fraction), decimals + int(exponent or 0) - len(fraction)
    value = digits * 10 ** shift if shift >= 0 else digits // 10 ** -shift
    if value >= 2 ** 63:
        raise ValueError(f'not a time of this epoch: {text!r}')
    return -value if sign == '-' else value


def format_stamp(stamp_ns: int) -> str:
    """Return seconds with nine decimals, the inverse of `parse_stamp_ns`."""
    sign = '-' if stamp_ns < 0 else ''
    seconds, nanoseconds = divmod(abs(int(stamp_ns)), NANOSECONDS)
    return f'{sign}{seconds}.{nanoseconds:09d}'


@dataclass(frozen=True)
class Trajectory:
    """Stamped poses.

    ``stamps_ns`` (N,) int64, strictly increasing for odometry, in file order for ground truth;
    ``poses`` (N, 4, 4) float64, T_world_x; ``has_rotation`` is False for point measurements
    (a prism, a GNSS antenna), whose rotations are identity and have no meaning.
    """

    stamps_ns: np.ndarray
    poses: np.ndarray
    has_rotation: bool = True

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> np.ndarray:
        """Positions (N, 3)."""
        return self.poses[:, :3, 3]

    @property
    def path_length(self) -> float:
        """Sum of the distances between consecutive positions."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def select(self, indices: np.ndarray) -> Trajectory:
        """Return the poses at `indices`."""
        return Trajectory(self.stamps_ns[indices], self.poses[indices], self.has_rotation)

    def right_multiplied(self, T_x_y: np.ndarray) -> Trajectory:
        """Return the trajectory of y, rigidly mounted on x: T_world_y = T_world_x T_x_y."""
        return Trajectory(self.stamps_ns, self.poses @ T_x_y, self.has_rotation)


def associate(stamps_ns: np.ndarray, reference_ns: np.ndarray,
              limit_ns: int = ASSOCIATION_LIMIT_NS) -> tuple[np.ndarray, np.ndarray]:
    """Match stamps to their nearest reference, one to one and within `limit_ns`.

    Returns index arrays into `stamps_ns` and `reference_ns`, in the order of `stamps_ns`. Of
    two stamps with the same nearest reference, the nearer stamp is matched.
    """
    stamps_ns, reference_ns = np.asarray(stamps_ns), np.asarray(reference_ns)
    if len(stamps_ns) == 0 or len(reference_ns) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    order = np.argsort(reference_ns, kind='stable')
    ordered = reference_ns[order]
    after = np.clip(np.searchsorted(ordered, stamps_ns), 1, max(len(ordered) - 1, 1))
    after = np.minimum(after, len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(ordered[before] - stamps_ns) <= np.abs(ordered[after] - stamps_ns),
                       before, after)
    distance = np.abs(ordered[nearest] - stamps_ns)
    candidates = np.flatnonzero(distance <= limit_ns)
    candidates = candidates[np.lexsort((candidates, distance[candidates]))]
    _, first = np.unique(nearest[candidates], return_index=True)
    matched = np.sort(candidates[first])
    return matched, order[nearest[matched]]


def format_tum_line(stamp_ns: int, T_world_x: np.ndarray) -> str:
    """Return a line of a TUM file, ``stamp tx ty tz qx qy qz qw``, with its newline."""
    quat_xyzw = geometry.quat_xyzw_from_rotation(T_world_x[:3, :3])
    numbers = ' '.join(f'{value:.9f}' for value in (*T_world_x[:3, 3], *quat_xyzw))
    return f'{format_stamp(stamp_ns)} {numbers}\n'


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file (``stamp tx ty tz qx qy qz qw`` per line, ``#`` comments), T_world_x.

    Raises KfvoError naming the first line that is not eight numbers.
    """
    rows = read_rows(path, 'stamp tx ty tz qx qy qz qw', _parse_stamped_pose)
    values = np.array([row for _, row in rows], dtype=np.float64).reshape(-1, 7)
    return Trajectory(np.array([stamp_ns for stamp_ns, _ in rows], dtype=np.int64),
                      geometry.transform_from_xyz_quat(values))


def read_pose_table(path: Path, parse_stamp: Callable[[str], int],
                    scalar_first: bool = False) -> Trajectory:
    """Read measured poses, one ``stamp x y z qx qy qz qw`` per line; later columns are ignored.

    Rows of ``stamp x y z`` are positions without rotation. A column of row numbers before the
    stamp is skipped. `scalar_first`: the quaternion is qw qx qy qz. Rows without a credible pose
    (lost tracking, a cut line) are left out with a warning. Raises KfvoError if all are.
    """
    lines = read_lines(path)
    start = list(islice(lines, 4))
    first = 1 if _is_numbered([_split(line) for _, line in start]) else 0
    # Stamps and numbers of poses and of positions, of which the more frequent are taken.
    tables: dict[int, tuple[array[int], array[float]]] = {
        size: (array('q'), array('d')) for size in (7, 3)}
    bad = _LeftOut(path, f'stamp x y z {"qw qx qy qz" if scalar_first else "qx qy qz qw"}')
    for number, line in chain(start, lines):
        fields = _split(line)
        size = 3 if len(fields) == first + 4 else 7
        try:
            stamp_ns = parse_stamp(fields[first])
            row = [float(field) for field in fields[first + 1:first + 1 + size]]
        except (ValueError, IndexError):
            row = []
        if len(row) == size and is_credible(row):
            tables[size][0].append(stamp_ns)
            tables[size][1].extend(row)
        else:
            bad.add(number, line)
    has_rotation = len(tables[7][0]) >= len(tables[3][0])
    size = 7 if has_rotation else 3
    bad.finish(len(tables[7][0]) + len(tables[3][0]), len(tables[10 - size][0]))
    stamps_ns = np.array(tables[size][0], dtype=np.int64)
    values = np.array(tables[size][1], dtype=np.float64).reshape(-1, size)
    if not has_rotation:
        return Trajectory(stamps_ns, geometry.make_transform(
            np.tile(np.eye(3), (len(values), 1, 1)), values), has_rotation=False)
    order = [0, 1, 2, 4, 5, 6, 3] if scalar_first else [0, 1, 2, 3, 4, 5, 6]
    return Trajectory(stamps_ns, geometry.transform_from_xyz_quat(values[:, order]))


def read_numbered_rows(path: Path, count: int, form: str, stamps_ns: np.ndarray
                       ) -> tuple[np.ndarray, np.ndarray]:
    """Read `count` numbers per line, one line per stamp; return the stamps and numbers (N, count).

    A column of row numbers before them is skipped. Rows that are not credible are left out with
    a warning. Raises KfvoError for another number of lines, and if all are left out.
    """
    kept, rows, line_count = [], [], 0
    bad = _LeftOut(path, form)
    for index, (number, line) in enumerate(read_lines(path)):
        line_count += 1
        fields = _split(line)
        is_numbered = len(fields) == count + 1 and fields[0].isdecimal()
        try:
            row = parse_floats(fields[is_numbered:], count)
        except ValueError:
            row = []
        if row and is_credible(row):
            rows.append(row)
            kept.append(index)
        else:
            bad.add(number, line)
    if rows and line_count != len(stamps_ns):
        raise KfvoError(f'{path} holds {line_count} poses for {len(stamps_ns)} frames; '
                        'expected one line per frame')
    bad.finish(len(rows))
    return (np.asarray(stamps_ns, dtype=np.int64)[kept],
            np.array(rows, dtype=np.float64).reshape(-1, count))


def read_kitti_poses(path: Path, stamps_ns: np.ndarray) -> Trajectory:
    """Read a KITTI pose file (12 numbers per frame, the rows of T_world_camera 3x4).

    The few digits of the file leave errors of 1e-7 in the rotations, which are renormalised.
    Rows without a rotation in them are left out with a warning. Raises KfvoError where
    `read_numbered_rows` does, and without any rotation.
    """
    kept_ns, rows = read_numbered_rows(path, 12, '12 numbers', stamps_ns)
    matrices = rows.reshape(-1, 3, 4)
    stored = geometry.make_transform(matrices[:, :, :3], matrices[:, :, 3])
    poses = geometry.orthonormalise(stored)
    good = np.abs(poses - stored).max(axis=(1, 2)) <= 1e-2
    wrong = np.flatnonzero(~good)
    if not good.any():
        raise KfvoError(f'{path}, pose {wrong[0]} (from 0): expected a rotation in the first '
                        'three columns, found another matrix; are these poses?')
    if len(wrong):
        _log.warning('%s: left out %d poses of %d without a rotation, the first is pose %d '
                     '(from 0)', path, len(wrong), len(poses), wrong[0])
    return Trajectory(kept_ns[good], poses[good])


def is_credible(row: Sequence[float]) -> bool:
    """Return whether ``x y z [qx qy qz qw ...]`` is finite and near, and its rotation not zero."""
    if not all(-MAX_POSITION <= value <= MAX_POSITION for value in row):  # False for NaN
        return False
    return len(row) != 7 or math.hypot(*row[3:]) >= 1e-3


class _LeftOut:
    """Counts the rows of a file that are left out, and remembers the first."""

    def __init__(self, path: Path, form: str) -> None:
        self._path, self._form = path, form
        self._count, self._first = 0, ''

    def add(self, number: int, line: str) -> None:
        """Count a row that is not of the form."""
        if not self._count:
            self._first = (f'line {number}: expected "{self._form}", finite and credible, found '
                           f'{line[:80]!r}')
        self._count += 1

    def finish(self, good: int, other: int = 0) -> None:
        """Log the number, of `other` rows too; raise KfvoError if there is no good one."""
        if self._count and not good:
            raise KfvoError(f'{self._path}, {self._first}')
        if self._count + other:
            first = f'; {self._first}' if self._first else ' without a rotation, unlike the others'
            _log.warning('%s: left out %d rows of %d%s', self._path, self._count + other,
                         self._count + good, first)


def _split(line: str) -> list[str]:
    return line.replace(',', ' ').replace(';', ' ').split()


def _is_numbered(rows: list[list[str]]) -> bool:
    """Return whether rows of a table of stamped poses begin with their numbers, from 0 or 1."""
    rows = [fields for fields in rows if fields and fields[0].isdecimal()]
    numbers = [int(fields[0]) for fields in rows]
    return len(rows) > 1 and numbers[0] <= 1 and \
        all(len(fields) == 5 or len(fields) >= 9 for fields in rows) and \
        numbers == list(range(numbers[0], numbers[0] + len(rows)))


def _parse_stamped_pose(line: str) -> tuple[int, list[float]]:
    stamp, *fields = line.replace(',', ' ').split()
    return parse_stamp_ns(stamp), parse_pose(fields)
