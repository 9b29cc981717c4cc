# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every number by which a benchmark compares an estimate with the truth."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

from kfvo_ros import metrics
from kfvo_ros.drift import odometry_drift
from kfvo_ros.errors import KfvoError
from kfvo_ros.trajectory import Trajectory


@dataclass(frozen=True)
class Scores:
    """Errors of one estimate; None where there is no such thing.

    The Sim(3) scale is taken out of the estimate first, but for ``ate_se3_rmse_m``.
    ``ate_scale`` is that scale [m per unit], ``ate_percent`` the ATE in % of the true path.
    ``rpe_trans`` [m] and ``rpe_rot_deg`` are RMSE over one second, ``..._per_metre`` over one
    metre of true path; ``kitti_...`` are KITTI's drift.
    """

    ate_rmse_m: float | None = None
    ate_scale: float | None = None
    ate_se3_rmse_m: float | None = None
    path_length_m: float | None = None
    ate_percent: float | None = None
    rpe_trans: float | None = None
    rpe_rot_deg: float | None = None
    rpe_trans_per_metre: float | None = None
    rpe_rot_deg_per_metre: float | None = None
    kitti_trans_percent: float | None = None
    kitti_rot_deg_per_100m: float | None = None


def score(estimate: Trajectory, truth: Trajectory) -> Scores:
    """Return all errors that this pair of trajectories defines.

    No truth that stands still has a scale, no prism a rotation, no path within a room KITTI's
    drift over 100 m. Raises KfvoError where the two do not belong together at all
    (`metrics.match`).
    """
    unscaled = metrics.absolute_trajectory_error(estimate, truth, with_scale=False)
    errors = {'ate_se3_rmse_m': unscaled.rmse, 'path_length_m': unscaled.path_length}
    with suppress(KfvoError):
        aligned = metrics.absolute_trajectory_error(estimate, truth)
        errors |= {'ate_rmse_m': aligned.rmse,
                   'ate_percent': 100.0 * aligned.rmse / aligned.path_length}
        if metrics.extent(estimate) > 0.0:  # what never moved fits at any scale
            errors['ate_scale'] = aligned.alignment.scale
    with suppress(KfvoError):
        second = metrics.relative_pose_error(estimate, truth, 1.0, 'seconds')
        errors |= {'rpe_trans': second.trans_rmse, 'rpe_rot_deg': second.rot_rmse_deg}
    with suppress(KfvoError):
        metre = metrics.relative_pose_error(estimate, truth, 1.0, 'metres')
        errors |= {'rpe_trans_per_metre': metre.trans_rmse,
                   'rpe_rot_deg_per_metre': metre.rot_rmse_deg}
    with suppress(KfvoError):
        drift = odometry_drift(estimate, truth)
        errors |= {'kitti_trans_percent': drift.trans_percent,
                   'kitti_rot_deg_per_100m': drift.rot_deg_per_100m}
    return Scores(**errors)
