# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamped poses, and their TUM and KITTI files.

A stamp is an int of nanoseconds. Decimal text becomes nanoseconds without a float in between,
because a float64 of a present-day epoch resolves only 0.2 microseconds.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.files import parse_floats, parse_pose, read_rows

NANOSECONDS = 1_000_000_000
ASSOCIATION_LIMIT_NS = 10_000_000
"""Largest time difference of a frame and its ground truth (10 ms)."""
UNKNOWN_VARIANCE = 9999.0
"""Variance of an unmeasured velocity, rtabmap's value; zero would mean exact."""
_DECIMAL = re.compile(r'([+-]?)([0-9]*)\.?([0-9]*)(?:[eE]([+-]?[0-9]{1,3}))?')


def parse_stamp_ns(text: str) -> int:
    """Return nanoseconds of decimal seconds, exact to the ninth decimal (the rest is truncated).

    Exponents, which KITTI's times.txt uses, are accepted. Raises ValueError for other text and
    for times beyond 64 bits of nanoseconds (292 years).
    """
    match = _DECIMAL.fullmatch(text.strip())
    if match is None or not match[2] + match[3]:
        raise ValueError(f'not a decimal number of seconds: {text!r}')
    sign, whole, fraction, exponent = match.groups()
    digits, shift = int(whole + fraction), 9 + int(exponent or 0) - len(fraction)
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


def read_kitti_poses(path: Path, stamps_ns: np.ndarray) -> Trajectory:
    """Read a KITTI pose file (12 numbers per frame, the rows of T_world_camera 3x4).

    The few digits of the file leave errors of 1e-7 in the rotations, which are renormalised.
    Raises KfvoError when a line is not 12 numbers with a rotation in them, or the file is not
    one pose per stamp.
    """
    rows = read_rows(path, '12 numbers', lambda line: parse_floats(line.split(), 12))
    if len(rows) != len(stamps_ns):
        raise KfvoError(f'{path} holds {len(rows)} poses for {len(stamps_ns)} frames; '
                        'expected one line per frame')
    matrices = np.array(rows, dtype=np.float64).reshape(-1, 3, 4)
    stored = geometry.make_transform(matrices[:, :, :3], matrices[:, :, 3])
    poses = geometry.orthonormalise(stored)
    wrong = np.flatnonzero(np.abs(poses - stored).max(axis=(1, 2)) > 1e-2)
    if len(wrong):
        raise KfvoError(f'{path}, pose {wrong[0]} (from 0): expected a rotation in the first '
                        'three columns, found another matrix; are these poses?')
    return Trajectory(np.asarray(stamps_ns, dtype=np.int64), poses)


def _parse_stamped_pose(line: str) -> tuple[int, list[float]]:
    stamp, *fields = line.replace(',', ' ').split()
    return parse_stamp_ns(stamp), parse_pose(fields)
