# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How well a keyframe policy does on drives that it does not learn from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.evaluation import metrics
from kfvo_ros.keyframes.base import KeyframePolicy
from kfvo_ros.keyframes.guard import NO_GUARD
from kfvo_ros.keyframes.learned import PolicySignature
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.keyframe_odometry import FramePose, KeyframeOdometry
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.training.ablation import PolicyResult
from kfvo_ros.training.baselines import GuardOnly, RandomPolicy, reference_policies
from kfvo_ros.training.config import TrainingConfig
from kfvo_ros.training.encoded_sequence import EncodedSequence
from kfvo_ros.trajectory import Trajectory

if TYPE_CHECKING:
    pass


LEAST_PERCENT = 1e-6
"""A geometric mean knows no zero."""
SEEDS = (0, 1, 2)
"""Seeds of the random policy."""


@dataclass(frozen=True)
class Score:
    """Mean error and number of keyframes of a policy.

    ``ate_percent``: RMSE over all frames after Sim(3), in per cent of the path, as geometric
    mean over the drives; ``kept``: the share of their frames that became keyframes.
    """

    ate_percent: float
    kept: float


def ate_percent(estimate: Trajectory, drive: EncodedSequence) -> float:
    """Return the ATE [% of the path]; raises KfvoError for a drive that never moves."""
    try:
        error = metrics.absolute_trajectory_error(estimate, drive.truth)
    except KfvoError as problem:
        raise KfvoError(f'{drive.name}: {problem}') from problem
    return max(100.0 * error.rmse / error.path_length, LEAST_PERCENT)


@dataclass(frozen=True)
class Validation:
    """Runs policies over ``drives``: frames whose truth is known, as an odometry would."""

    drives: Sequence[EncodedSequence]
    backbone: Backbone
    setting: PolicySignature

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

    def _run(self, policy: KeyframePolicy, drive: EncodedSequence) -> tuple[Trajectory, int]:
        """Return the refined poses of all frames, and how many frames were kept."""
        odometry = KeyframeOdometry(self.backbone, policy, self.setting.scale_rule,
                                    self.setting.window_size, with_covariance=False)
        placed: list[FramePose] = []
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


class TrainingCallback(ABC):
    """What is raised here ends the training where nothing is cut in two: between two steps."""

    @abstractmethod
    def stepped(self, steps: int) -> None:
        """Take note of so many steps."""

    @abstractmethod
    def collected(self, mean_return: float, keyframe_rate: float) -> None:
        """Take note of the latest episodes' return, and of the share of frames kept."""

    @abstractmethod
    def validating(self) -> None:
        """Take note that another drive is about to be run."""

    @abstractmethod
    def validated(self, steps: int, score: Score, is_best: bool) -> None:
        """Take note of the policy's score after so many steps."""


@dataclass(frozen=True)
class PolicyEvaluation:
    """Runs policies over ``drives``, by the names of their sequences, as an odometry would."""

    drives: Mapping[str, EncodedSequence]
    backbone: Backbone
    options: OdometryOptions

    @property
    def setting(self) -> PolicySignature:
        """What a learned policy must fit."""
        return factory.signature_of(self.options, self.backbone)

    def outcomes(self, row: str, seed: int | None, policy: KeyframePolicy) -> Iterator[PolicyResult]:
        """Yield how the policy does on one drive after the other."""
        for name, drive in self.drives.items():
            score = Validation([drive], self.backbone, self.setting).score(policy)
            yield PolicyResult(row, seed, name, score.ate_percent, score.kept)

    def unlearned(self, recipe: TrainingConfig) -> Iterator[PolicyResult]:
        """Yield how the heuristics do, a recipe's teacher, chance and nothing inside its rail.

        And no odometry at all.
        """
        rail = recipe.rail or NO_GUARD
        for name, policy in reference_policies(recipe, self.options, self.backbone).items():
            yield from self.outcomes(name, None, policy)
        for seed in SEEDS:
            yield from self.outcomes(RandomPolicy.name, seed, RandomPolicy(rail, seed))
        if recipe.rail is not None:
            yield from self.outcomes(GuardOnly.name, None, GuardOnly(rail))
        for trivial in (metrics.constant_position, metrics.straight_line):
            for name, drive in self.drives.items():
                percent = ate_percent(trivial(drive.truth.stamps_ns), drive)
                yield PolicyResult(trivial.__name__, None, name, percent, 0.0)
