# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectory metrics: ATE, RPE, KITTI's drift, trivial baselines and amounts of motion.

Every metric takes the estimate and the ground truth as they were recorded and associates them
itself. A monocular estimate has no scale, so by default the Sim(3) scale is removed first. ATE
and RPE agree with evo; definitions: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM
systems", IROS 2012, and Geiger et al., "Are we ready for autonomous driving?", CVPR 2012.
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

Unit = Literal['frames', 'seconds', 'metres']
MIN_MATCHES = 3
REL_DELTA_TOLERANCE = 0.1
"""Relative tolerance of the distance between two poses of a pair, in metres or seconds."""
KITTI_LENGTHS_M = tuple(range(100, 801, 100))
KITTI_STEP = 10
"""Sub-sequences start at every tenth frame, as in KITTI's development kit."""


@dataclass(frozen=True)
class AbsoluteError:
    """Absolute trajectory error: distances of aligned positions to the ground truth [m].

    ``rmse``; ``alignment`` maps the estimate's world to that of the ground truth; ``errors`` (N,)
    at the associated ``stamps_ns`` (N,); ``path_length`` of the associated ground truth.
    """

    rmse: float
    alignment: Similarity
    stamps_ns: np.ndarray
    errors: np.ndarray
    path_length: float


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error: differences between estimated and true motion over pairs of poses.

    RMSE over the pairs; ``trans`` (M,) [m] and ``rot_deg`` (M,) of each pair, which starts at
    ``stamps_ns`` (M,).
    """

    trans_rmse: float
    rot_rmse_deg: float
    stamps_ns: np.ndarray
    trans: np.ndarray
    rot_deg: np.ndarray


@dataclass(frozen=True)
class Drift:
    """KITTI translational [%] and rotational [deg/100 m] drift: means over sub-sequences.

    ``first``, ``last`` (M,): indices of the associated frames; ``lengths`` (M,) [m]; ``trans``
    (M,) [%] and ``rot`` (M,) [deg/100 m] of each sub-sequence.
    """

    trans_percent: float
    rot_deg_per_100m: float
    first: np.ndarray
    last: np.ndarray
    lengths: np.ndarray
    trans: np.ndarray
    rot: np.ndarray


def absolute_trajectory_error(estimate: Trajectory, truth: Trajectory,
                              with_scale: bool = True) -> AbsoluteError:
    """Return the ATE after least-squares alignment by Sim(3), or by SE(3) without scale.

    Raises KfvoError where `associate_trajectories` does, and for a ground truth that never moves
    if `with_scale`.
    """
    estimate, truth = associate_trajectories(estimate, truth)
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
    """Return the RPE over all pairs of poses that are `delta` apart in the ground truth.

    The estimate is first multiplied by its ATE's Sim(3) scale, unless `with_scale` is False.
    Each pose pairs with the later pose nearest to `delta` frames, seconds or metres of true path
    away, within REL_DELTA_TOLERANCE (evo: all pairs, from the reference). Raises KfvoError where
    the ATE does, when there is no such pair, and for positions without rotation.
    """
    estimate, truth = associate_and_scale(estimate, truth, with_scale)
    first, second = _pairs(truth, delta, unit)
    trans, rot_deg = motion_errors(estimate, truth, first, second)
    return RelativeError(_rmse(trans), _rmse(rot_deg), estimate.stamps_ns[first], trans, rot_deg)


def kitti_drift(estimate: Trajectory, truth: Trajectory, with_scale: bool = True) -> Drift:
    """Return the drift over all sub-sequences of 100 to 800 m of true path.

    The estimate is first multiplied by its ATE's Sim(3) scale, unless `with_scale` is False;
    KITTI's own kit, made for cameras of known scale, does not. Raises KfvoError where the RPE
    does, and for a path of at most 100 m.
    """
    estimate, truth = associate_and_scale(estimate, truth, with_scale)
    distances = accumulated_distances(truth, 'metres')
    first, lengths = (each.ravel() for each in np.meshgrid(
        np.arange(0, len(truth), KITTI_STEP), np.array(KITTI_LENGTHS_M, dtype=np.float64),
        indexing='ij'))
    last = np.searchsorted(distances, distances[first] + lengths, side='right')
    reached = last < len(truth)
    if not reached.any():
        raise KfvoError(f'expected a path of more than {KITTI_LENGTHS_M[0]} m for the drift, the '
                        f'true one is {distances[-1]:.1f} m long; ask for a relative pose error')
    first, last, lengths = first[reached], last[reached], lengths[reached]
    trans, rot_deg = motion_errors(estimate, truth, first, last)
    trans, rot = 100.0 * trans / lengths, 100.0 * rot_deg / lengths
    return Drift(float(np.mean(trans)), float(np.mean(rot)), first, last, lengths, trans, rot)


def constant_position(stamps_ns: np.ndarray) -> Trajectory:
    """Return the constant-position baseline: identity poses at the stamps (N,)."""
    return Trajectory(stamps_ns, np.tile(np.eye(4), (len(stamps_ns), 1, 1)))


def straight_line(stamps_ns: np.ndarray) -> Trajectory:
    """Return the straight-line baseline: one unit per second along x, no rotation.

    Once aligned by Sim(3) it is the straight line of constant speed that fits best.
    """
    line = constant_position(stamps_ns)
    line.poses[:, 0, 3] = accumulated_distances(line, 'seconds')
    return line


def extent(trajectory: Trajectory) -> float:
    """Return the largest distance from the first position, 0 without poses.

    Divided by the median depth of the scene it is the parallax of the whole motion [rad], which
    detects a standing camera at any scale.
    """
    return float(np.linalg.norm(trajectory.positions - trajectory.positions[:1],
                                axis=1).max(initial=0.0))


def max_rotation_deg(trajectory: Trajectory) -> float:
    """Return the largest rotation angle [deg] from the first pose, 0 without poses."""
    rotations = geometry.relative(trajectory.poses[:1], trajectory.poses)[:, :3, :3]
    return float(np.rad2deg(geometry.rotation_angle(rotations)).max(initial=0.0))


def associate_trajectories(estimate: Trajectory, truth: Trajectory
                           ) -> tuple[Trajectory, Trajectory]:
    """Return the associated poses of both, N each, in time order.

    Nearest stamps, one to one, within 10 ms; nothing is interpolated. Raises KfvoError for fewer
    than three matches and for a pose that is not finite.
    """
    estimate = estimate.select(np.argsort(estimate.stamps_ns, kind='stable'))
    matched, nearest = associate(estimate.stamps_ns, truth.stamps_ns)
    if len(matched) < MIN_MATCHES:
        raise KfvoError(
            f'expected at least {MIN_MATCHES} poses with ground truth within '
            f'{ASSOCIATION_LIMIT_NS // 1_000_000} ms, found {len(matched)} of {len(estimate)}; '
            f'estimate {_time_span(estimate)}, truth {_time_span(truth)}: '
            'are both on the same clock?')
    estimate, truth = estimate.select(matched), truth.select(nearest)
    for name, poses in (('estimate', estimate.poses), ('ground truth', truth.poses)):
        if not np.isfinite(poses).all():
            raise KfvoError(f'the {name} holds a pose that is not finite; expected numbers only')
    return estimate, truth


def associate_and_scale(estimate: Trajectory, truth: Trajectory, with_scale: bool = True
                        ) -> tuple[Trajectory, Trajectory]:
    """Return the associated poses of both, the estimate's positions in the scale of the truth.

    That scale is the ATE's; it stays 1 unless `with_scale`. Raises KfvoError where the ATE does,
    and for positions without rotation.
    """
    if not (truth.has_rotation and estimate.has_rotation):
        raise KfvoError('expected poses, found positions without rotation: these give an '
                        'absolute trajectory error only')
    scale = absolute_trajectory_error(estimate, truth, with_scale).alignment.scale
    estimate, truth = associate_trajectories(estimate, truth)
    poses = estimate.poses.copy()
    poses[:, :3, 3] *= scale
    return Trajectory(estimate.stamps_ns, poses), truth


def motion_errors(estimate: Trajectory, truth: Trajectory, first: np.ndarray,
                  second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the translational (M,) [m] and rotational (M,) [deg] errors of motions.

    The m-th motion goes from pose ``first[m]`` to pose ``second[m]`` of both trajectories.
    """
    estimated_motion, true_motion = (geometry.relative(each.poses[first], each.poses[second])
                                     for each in (estimate, truth))
    error = geometry.relative(true_motion, estimated_motion)
    return (np.linalg.norm(error[:, :3, 3], axis=1),
            np.rad2deg(geometry.rotation_angle(error[:, :3, :3])))


def accumulated_distances(trajectory: Trajectory, unit: Unit) -> np.ndarray:
    """Return the distance (N,) of every pose from the first along the trajectory, in `unit`."""
    if unit == 'frames':
        return np.arange(len(trajectory), dtype=np.float64)
    if unit == 'seconds':
        return (trajectory.stamps_ns - trajectory.stamps_ns[:1]) / NANOSECONDS
    if unit == 'metres':
        steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])
    raise KfvoError(f"expected unit 'frames', 'seconds' or 'metres', {unit!r} came")


def _pairs(truth: Trajectory, delta: float, unit: Unit) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (M,), (M,) of first and second pose of all pairs `delta` apart."""
    if not 0.0 < delta < np.inf or (unit == 'frames' and delta != int(delta)):
        raise KfvoError(f'expected a positive (for frames: whole) delta, {delta} came')
    distances = accumulated_distances(truth, unit)
    tolerance = 0.0 if unit == 'frames' else REL_DELTA_TOLERANCE * delta
    first = np.arange(len(truth) - 1)
    target = distances[first] + delta
    after = np.minimum(np.searchsorted(distances, target), len(truth) - 1)
    # Where the camera paused, the first pose of the pause stands for all of them.
    before = np.searchsorted(distances, distances[after - 1])
    second = np.where(np.abs(distances[before] - target) <= np.abs(distances[after] - target),
                      before, after)
    close = (np.abs(distances[second] - target) <= tolerance) & (second > first)
    if not close.any():
        raise KfvoError(f'no two of the {len(truth)} poses are {delta:g} {unit} apart, they '
                        f'span {distances[-1]:g} {unit}; ask for less')
    return first[close], second[close]


def _rmse(errors: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(errors ** 2)))


def _time_span(trajectory: Trajectory) -> str:
    """Return the time span in words."""
    if len(trajectory) == 0:
        return 'is empty'
    first, last = trajectory.stamps_ns.min(), trajectory.stamps_ns.max()
    return f'from {format_stamp(first)} to {format_stamp(last)} s'
