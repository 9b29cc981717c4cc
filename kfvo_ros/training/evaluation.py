# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Evaluation of keyframe policies on sequences with ground truth, and policies to compare with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation import metrics
from kfvo_ros.keyframes import HEURISTICS
from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy
from kfvo_ros.keyframes.guard import NO_GUARD, KeyframeGuard
from kfvo_ros.keyframes.heuristics import ParallaxPolicy
from kfvo_ros.keyframes.learned import PolicySignature
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.odometry.updates import FramePose
from kfvo_ros.training.config import TrainingConfig
from kfvo_ros.training.encoded_sequence import EncodedSequence
from kfvo_ros.trajectory import Trajectory

MIN_PERCENT = 1e-6
"""A geometric mean of errors needs positive ones."""
EXPERT = 'teacher'
"""Name of the recipe's expert in scores and tables."""


@dataclass(frozen=True)
class Score:
    """Error and keyframes of a policy.

    ``ate_percent`` is the RMSE over all frames after Sim(3), in per cent of the path, as the
    geometric mean over sequences; ``kept`` is the share of their frames that became keyframes.
    """

    ate_percent: float
    kept: float


@dataclass(frozen=True)
class PolicyEvaluation:
    """Runs the odometry over ``sequences`` with the policy to evaluate.

    ``signature`` is what a learned policy must fit.
    """

    sequences: Sequence[EncodedSequence]
    backbone: Backbone
    signature: PolicySignature

    def score(self, policy: KeyframePolicy,
              before_sequence: Callable[[], None] = lambda: None) -> Score:
        """Return the score over all sequences; `before_sequence` is called before each.

        Raises KfvoError for a sequence that never moves.
        """
        percents, keyframes, frames = [], 0, 0
        for sequence in self.sequences:
            before_sequence()
            estimate, count = self._run(policy, sequence)
            percents.append(ate_percent(estimate, sequence))
            keyframes, frames = keyframes + count, frames + len(sequence)
        return Score(float(np.exp(np.mean(np.log(percents)))), keyframes / frames)

    def scores(self, policy: KeyframePolicy) -> list[Score]:
        """Return the score of each sequence."""
        return [replace(self, sequences=[sequence]).score(policy) for sequence in self.sequences]

    def _run(self, policy: KeyframePolicy, sequence: EncodedSequence) -> tuple[Trajectory, int]:
        """Return the refined poses of all frames, and the number of keyframes."""
        odometry = KeyframeOdometry(self.backbone, policy, self.signature.scale_rule,
                                    self.signature.window_size, with_covariance=False)
        final: list[FramePose] = []
        for frame, encoded in zip(sequence.frames, sequence.encoded, strict=True):
            window = odometry.encode(frame, encoded)
            estimate = self.backbone.estimate([window])[0] if window is not None else None
            step = odometry.integrate(estimate)
            keep = step.keep if step.decision is None else policy.decide(step.decision)
            final += odometry.commit(keep, {}).final
        final += odometry.finish()
        return (Trajectory(np.array([each.stamp_ns for each in final], dtype=np.int64),
                           np.stack([each.T_world_camera for each in final])),
                sum(each.is_keyframe for each in final))


def ate_percent(estimate: Trajectory, sequence: EncodedSequence) -> float:
    """Return the ATE [% of the path]; raises KfvoError for a sequence that never moves."""
    try:
        error = metrics.absolute_trajectory_error(estimate, sequence.truth)
    except KfvoError as problem:
        raise KfvoError(f'{sequence.name}: {problem}') from problem
    return max(100.0 * error.rmse / error.path_length, MIN_PERCENT)


class GuardOnly(KeyframePolicy):
    """Drops every frame that the guard does not keep."""

    name = 'rail'

    def __init__(self, guard: KeyframeGuard) -> None:
        self._guard = guard
        self.needs_tracks = guard.needs_tracks

    def decide(self, decision: DecisionInput) -> bool:
        """Return True where the guard forces to keep."""
        return bool(self._guard.forced(decision))


class RandomPolicy(KeyframePolicy):
    """Keeps half of the frames at random, where the guard forces nothing."""

    name = 'random'

    def __init__(self, guard: KeyframeGuard, seed: int) -> None:
        self._guard = guard
        self.needs_tracks = guard.needs_tracks
        self._rng = np.random.default_rng(seed)

    def decide(self, decision: DecisionInput) -> bool:
        """Return the guard's decision, else a random one."""
        forced = self._guard.forced(decision)
        return forced if forced is not None else bool(self._rng.integers(2))


def reference_policies(recipe: TrainingConfig, options: OdometryOptions,
                       backbone: Backbone) -> dict[str, KeyframePolicy]:
    """Return the heuristics and the recipe's expert by name."""
    policies = {name: factory.make_policy(replace(options, keyframes=name), backbone)
                for name in HEURISTICS}
    if recipe.expert is not None:
        policies[EXPERT] = ParallaxPolicy(factory.signature_of(options, backbone).observation,
                                          recipe.expert, recipe.guard or NO_GUARD)
    return policies
