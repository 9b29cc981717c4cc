# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How well a keyframe policy does on drives that it does not learn from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from kfvo_ros import metrics
from kfvo_ros.backbones.base import Backbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import KeyframePolicy
from kfvo_ros.keyframes.learned import Setting
from kfvo_ros.learning.drives import Drive
from kfvo_ros.odometry import KeyframeOdometry, Placed
from kfvo_ros.trajectory import Trajectory

LEAST_PERCENT = 1e-6
"""A geometric mean knows no zero."""


@dataclass(frozen=True)
class Score:
    """Mean error and number of keyframes of a policy.

    ``ate_percent``: RMSE over all frames after Sim(3), in per cent of the path, as geometric
    mean over the drives; ``kept``: the share of their frames that became keyframes.
    """

    ate_percent: float
    kept: float


def ate_percent(estimate: Trajectory, drive: Drive) -> float:
    """Return the ATE [% of the path]; raises KfvoError for a drive that never moves."""
    try:
        error = metrics.absolute_trajectory_error(estimate, drive.truth)
    except KfvoError as problem:
        raise KfvoError(f'{drive.name}: {problem}') from problem
    return max(100.0 * error.rmse / error.path_length, LEAST_PERCENT)


@dataclass(frozen=True)
class Validation:
    """Runs policies over ``drives``: frames whose truth is known, as an odometry would."""

    drives: Sequence[Drive]
    backbone: Backbone
    setting: Setting

    def score(self, policy: KeyframePolicy,
              before_each: Callable[[], None] = lambda: None) -> Score:
        """Return how the policy does; `before_each` drive the caller has a say.

        Raises KfvoError for a drive that never moves.
        """
        percents, kept, frames = [], 0, 0
        for drive in self.drives:
            before_each()
            estimate, keyframes = self._run(policy, drive)
            percents.append(ate_percent(estimate, drive))
            kept, frames = kept + keyframes, frames + len(drive)
        return Score(float(np.exp(np.mean(np.log(percents)))), kept / frames)

    def _run(self, policy: KeyframePolicy, drive: Drive) -> tuple[Trajectory, int]:
        """Return the refined poses of all frames, and how many frames were kept."""
        odometry = KeyframeOdometry(self.backbone, policy, self.setting.scale_rule,
                                    self.setting.window_size, with_covariance=False)
        placed: list[Placed] = []
        for frame, encoded in zip(drive.frames, drive.encoded, strict=True):
            window = odometry.begin(frame, encoded)
            estimate = self.backbone.estimate([window])[0] if window is not None else None
            decision = odometry.integrate(estimate)
            keep = decision if isinstance(decision, bool) else policy.decide(decision)
            placed += odometry.commit(keep, {}).final
        placed += odometry.finish()
        return (Trajectory(np.array([each.stamp_ns for each in placed], dtype=np.int64),
                           np.stack([each.T_world_camera for each in placed])),
                sum(each.is_keyframe for each in placed))
