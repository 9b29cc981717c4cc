# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far an estimated trajectory is from the truth: ATE, RPE and the errors of doing nothing.

Every function takes the two trajectories as they were recorded and matches them itself. A
monocular estimate has no scale, so by default the Sim(3) scale is taken out first. The values
agree with evo's; definitions: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM
systems", IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.geometry import Similarity
from kfvo_ros.trajectory import (
    ASSOCIATION_LIMIT_NS,
    NANOSECONDS,
    Trajectory,
    associate,
    format_stamp,
)

MINIMUM_MATCHES = 3
PAIR_TOLERANCE = 0.1
"""A pair of poses may miss the wanted distance in metres or seconds by this fraction."""
Unit = Literal['frames', 'seconds', 'metres']
LENGTHS_M = tuple(range(100, 801, 100))
STEP = 10
"""Sub-sequences start at every tenth frame."""


@dataclass(frozen=True)
class AbsoluteError:
    """Distances of aligned positions to the truth [m].

    ``rmse``; ``alignment`` maps the estimate's world to the truth's; ``errors`` (N,) at the
    matched ``stamps_ns`` (N,); ``path_length`` of the truth through the matched poses.
    """

    rmse: float
    alignment: Similarity
    stamps_ns: np.ndarray
    errors: np.ndarray
    path_length: float


@dataclass(frozen=True)
class RelativeError:
    """Differences between estimated and true motion, from pose to later pose.

    RMSE over the pairs; ``trans`` (M,) [m] and ``rot_deg`` (M,) per pair, which starts at
    ``stamps_ns`` (M,).
    """

    trans_rmse: float
    rot_rmse_deg: float
    stamps_ns: np.ndarray
    trans: np.ndarray
    rot_deg: np.ndarray


def match(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Return the poses of both that belong together, N each, in time order.

    Nearest stamps, one to one, within 10 ms; nothing is interpolated. Raises KfvoError at
    fewer than three matches or a pose that is not finite.
    """
    estimate = estimate.select(np.argsort(estimate.stamps_ns, kind='stable'))
    matched, nearest = associate(estimate.stamps_ns, truth.stamps_ns)
    if len(matched) < MINIMUM_MATCHES:
        raise KfvoError(
            f'expected at least {MINIMUM_MATCHES} poses with ground truth within '
            f'{ASSOCIATION_LIMIT_NS // 1_000_000} ms, found {len(matched)} of {len(estimate)}; '
            f'estimate {_span(estimate)}, truth {_span(truth)}: are both on the same clock?')
    estimate, truth = estimate.select(matched), truth.select(nearest)
    for name, poses in (('estimate', estimate.poses), ('ground truth', truth.poses)):
        if not np.isfinite(poses).all():
            raise KfvoError(f'the {name} holds a pose that is not finite; expected numbers only')
    return estimate, truth


def absolute_trajectory_error(estimate: Trajectory, truth: Trajectory,
                              with_scale: bool = True) -> AbsoluteError:
    """Return the ATE after least-squares alignment by Sim(3), or SE(3) without scale.

    Raises KfvoError where `match` does, and when a scale is asked of a truth that never moves.
    """
    estimate, truth = match(estimate, truth)
    if with_scale and not np.ptp(truth.positions, axis=0).any():
        raise KfvoError('the ground truth never moves, so no Sim(3) scale is defined; expected '
                        'a moving truth, or ask for the error without scale')
    alignment = geometry.umeyama(estimate.positions, truth.positions, with_scale)
    errors = np.linalg.norm(alignment.transform_points(estimate.positions) - truth.positions,
                            axis=1)
    return AbsoluteError(_rmse(errors), alignment, estimate.stamps_ns, errors,
                         truth.path_length)


def relative_pose_error(estimate: Trajectory, truth: Trajectory, delta: float, unit: Unit,
                        with_scale: bool = True) -> RelativeError:
    """Return the RPE over all pairs of poses that are `delta` apart in the truth.

    The estimate is first multiplied by its ATE's Sim(3) scale, unless `with_scale` is False.
    From every pose a pair goes to the later pose nearest to `delta` frames, seconds or metres
    of true path away, within PAIR_TOLERANCE (evo: all pairs, from the reference). Raises
    KfvoError where the ATE does, when there is no such pair, and for a truth that measured
    positions only.
    """
    estimate, truth = match_motion(estimate, truth, with_scale)
    first, second = _pairs(truth, delta, unit)
    trans, rot_deg = motion_errors(estimate, truth, first, second)
    return RelativeError(_rmse(trans), _rmse(rot_deg), estimate.stamps_ns[first], trans, rot_deg)


def match_motion(estimate: Trajectory, truth: Trajectory, with_scale: bool = True
                 ) -> tuple[Trajectory, Trajectory]:
    """Return the matched poses of both, the estimate's positions in the truth's scale.

    That scale is the ATE's; it stays 1 unless `with_scale`. Raises KfvoError where the ATE does,
    and for positions without rotation.
    """
    if not (truth.has_rotation and estimate.has_rotation):
        raise KfvoError('expected poses, found positions without rotation: these give an '
                        'absolute trajectory error only')
    scale = absolute_trajectory_error(estimate, truth, with_scale).alignment.scale
    estimate, truth = match(estimate, truth)
    poses = estimate.poses.copy()
    poses[:, :3, 3] *= scale
    return Trajectory(estimate.stamps_ns, poses), truth


def motion_errors(estimate: Trajectory, truth: Trajectory, first: np.ndarray,
                  second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much (M,) [m] and (M,) [deg] the motions between matched poses differ.

    The m-th motion goes from pose ``first[m]`` to pose ``second[m]`` of both trajectories.
    """
    moved, truly_moved = (geometry.relative(each.poses[first], each.poses[second])
                          for each in (estimate, truth))
    error = geometry.relative(truly_moved, moved)
    return (np.linalg.norm(error[:, :3, 3], axis=1),
            np.rad2deg(geometry.rotation_angle(error[:, :3, :3])))


def constant_position(stamps_ns: np.ndarray) -> Trajectory:
    """Return the estimate of somebody who never looks: no motion at all."""
    return Trajectory(stamps_ns, np.tile(np.eye(4), (len(stamps_ns), 1, 1)))


def straight_line(stamps_ns: np.ndarray) -> Trajectory:
    """Return one unit per second along x without rotation; aligned, the best straight line."""
    line = constant_position(stamps_ns)
    line.poses[:, 0, 3] = distance_along(line, 'seconds')
    return line


def extent(trajectory: Trajectory) -> float:
    """Return the largest distance from the first position, 0 without poses.

    Divided by the median depth of the scene it is the parallax of the whole motion [rad], so
    it tells a camera that stood still whatever the scale.
    """
    return float(np.linalg.norm(trajectory.positions - trajectory.positions[:1],
                                axis=1).max(initial=0.0))


def max_rotation_deg(trajectory: Trajectory) -> float:
    """Return the largest rotation angle [deg] from the first pose, 0 without poses."""
    steps = geometry.relative(trajectory.poses[:1], trajectory.poses)
    return float(np.rad2deg(geometry.rotation_angle(steps[:, :3, :3])).max(initial=0.0))


def distance_along(truth: Trajectory, unit: Unit) -> np.ndarray:
    """Return how far every pose (N,) is from the first along the trajectory, in `unit`."""
    if unit == 'frames':
        return np.arange(len(truth), dtype=np.float64)
    if unit == 'seconds':
        return (truth.stamps_ns - truth.stamps_ns[:1]) / NANOSECONDS
    if unit == 'metres':
        steps = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])
    raise KfvoError(f"expected unit 'frames', 'seconds' or 'metres', {unit!r} came")


def _pairs(truth: Trajectory, delta: float, unit: Unit) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (M,), (M,) of first and second pose of all pairs `delta` apart."""
    if not 0.0 < delta < np.inf or (unit == 'frames' and delta != int(delta)):
        raise KfvoError(f'expected a positive (for frames: whole) delta, {delta} came')
    along, tolerance = distance_along(truth, unit), PAIR_TOLERANCE * delta
    if unit == 'frames':
        tolerance = 0.0
    first = np.arange(len(truth) - 1)
    wanted = along[first] + delta
    after = np.minimum(np.searchsorted(along, wanted), len(truth) - 1)
    # Where the camera paused, the first pose of the pause stands for all of them.
    before = np.searchsorted(along, along[after - 1])
    second = np.where(np.abs(along[before] - wanted) <= np.abs(along[after] - wanted),
                      before, after)
    close = (np.abs(along[second] - wanted) <= tolerance) & (second > first)
    if not close.any():
        raise KfvoError(f'no two of the {len(truth)} poses are {delta:g} {unit} apart, they '
                        f'span {along[-1]:g} {unit}; ask for less')
    return first[close], second[close]


def _rmse(errors: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(errors ** 2)))


def _span(trajectory: Trajectory) -> str:
    """Return the time span in words."""
    if len(trajectory) == 0:
        return 'is empty'
    first, last = trajectory.stamps_ns.min(), trajectory.stamps_ns.max()
    return f'from {format_stamp(first)} to {format_stamp(last)} s'


@dataclass(frozen=True)
class Drift:
    """Mean drift, and that of each sub-sequence.

    ``first``, ``last`` (M,): indices of the matched frames; ``lengths`` (M,) [m]; ``trans`` (M,)
    [%] and ``rot`` (M,) [deg/100 m].
    """

    trans_percent: float
    rot_deg_per_100m: float
    first: np.ndarray
    last: np.ndarray
    lengths: np.ndarray
    trans: np.ndarray
    rot: np.ndarray


def odometry_drift(estimate: Trajectory, truth: Trajectory, with_scale: bool = True) -> Drift:
    """Return the drift over all sub-sequences.

    The estimate is first multiplied by its ATE's Sim(3) scale, unless `with_scale` is False;
    KITTI itself, made for cameras that know their scale, does not. Raises KfvoError where the
    RPE does, and for a path that is nowhere longer than 100 m.
    """
    estimate, truth = match_motion(estimate, truth, with_scale)
    along = distance_along(truth, 'metres')
    first, lengths = (each.ravel() for each in np.meshgrid(
        np.arange(0, len(truth), STEP), np.array(LENGTHS_M, dtype=np.float64), indexing='ij'))
    last = np.searchsorted(along, along[first] + lengths, side='right')
    reached = last < len(truth)
    if not reached.any():
        raise KfvoError(f'expected a path of more than {LENGTHS_M[0]} m to tell its drift, the '
                        f'true one is {along[-1]:.1f} m long; ask for a relative pose error')
    first, last, lengths = first[reached], last[reached], lengths[reached]
    trans, rot_deg = motion_errors(estimate, truth, first, last)
    trans, rot = 100.0 * trans / lengths, 100.0 * rot_deg / lengths
    return Drift(float(np.mean(trans)), float(np.mean(rot)), first, last, lengths, trans, rot)
