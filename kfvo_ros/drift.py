# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far odometry drifts over hundreds of metres: KITTI's translational and rotational error.

Source: Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite",
CVPR 2012, and ``evaluate_odometry.cpp`` of the benchmark's devkit, which holds the definition:
from every tenth frame go sub-sequences of 100, 200 ... 800 m of true path; each ends at the first
frame that lies farther away; the error of the motion from its first to its last frame is divided
by the nominal length, and the mean is taken over all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros import metrics
from kfvo_ros.errors import KfvoError
from kfvo_ros.trajectory import Trajectory

LENGTHS_M = tuple(range(100, 801, 100))
STEP = 10
"""Sub-sequences start at every tenth frame."""


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
    estimate, truth = metrics.match_motion(estimate, truth, with_scale)
    along = metrics.distance_along(truth, 'metres')
    first, lengths = (each.ravel() for each in np.meshgrid(
        np.arange(0, len(truth), STEP), np.array(LENGTHS_M, dtype=np.float64), indexing='ij'))
    last = np.searchsorted(along, along[first] + lengths, side='right')
    reached = last < len(truth)
    if not reached.any():
        raise KfvoError(f'expected a path of more than {LENGTHS_M[0]} m to tell its drift, the '
                        f'true one is {along[-1]:.1f} m long; ask for a relative pose error')
    first, last, lengths = first[reached], last[reached], lengths[reached]
    trans, rot_deg = metrics.motion_errors(estimate, truth, first, last)
    trans, rot = 100.0 * trans / lengths, 100.0 * rot_deg / lengths
    return Drift(float(np.mean(trans)), float(np.mean(rot)), first, last, lengths, trans, rot)
