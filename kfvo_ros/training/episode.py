# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One sequence as a Markov decision process: keep the frame, or drop it (paper, section IV-A)."""

from __future__ import annotations

from collections import deque

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Backbone, Encoded, Estimate, Stream, Window
from kfvo_ros.keyframes.base import DecisionInput
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.keyframes.heuristics import EveryFrame
from kfvo_ros.odometry.keyframe_odometry import FramePose, KeyframeOdometry
from kfvo_ros.sequences.base import Frame
from kfvo_ros.training.encoded_sequence import EncodedSequence
from kfvo_ros.training.rewards import STANDSTILL_M, Reward

AHEAD = 2
"""So many true motions to come are told to the critic."""
POSE = 7
PRIVILEGED_SIZE = (1 + AHEAD) * POSE + 2


class Episode:
    """Drives through a sequence, and stops where there is something to decide.

    ``decision`` is what the policy sees there, None before the first one and once it ``ended``:
    at the last frame, or when the camera is lost. Where the rail decides nobody is asked, and
    before anybody was ``asked`` nothing is earned. The caller runs the backbone: encode what is
    `unseen`, `enter`, estimate the window, `leave`, until there is a decision.
    """

    def __init__(self, drive: EncodedSequence, backbone: Backbone, scale_rule: str, window_size: int,
                 rail: KeyframeGuard, reward: Reward) -> None:
        self._drive, self._rail, self._reward = drive, rail, reward
        self._odometry = KeyframeOdometry(backbone, EveryFrame(), scale_rule, window_size,
                                          with_covariance=False)
        self._trail: deque[FramePose] = deque(maxlen=reward.span or 0)
        self._next = 0
        self.decision: DecisionInput | None = None
        self.ended = False
        self.asked = False
        self._earned = 0.0

    def unseen(self) -> tuple[Stream, Frame] | None:
        """Return the next frame, and its stream, where it has to be encoded first."""
        if self._drive.encoded[self._next] is not None:
            return None
        frame = self._drive.frames[self._next]
        return self._odometry.open(frame.camera), frame

    def enter(self, encoded: Encoded | None = None) -> Window | None:
        """Take in the next frame; return the window to estimate, None for the very first."""
        index, self._next = self._next, self._next + 1
        return self._odometry.begin(self._drive.frames[index],
                                    encoded or self._drive.encoded[index])

    def leave(self, estimate: Estimate | None) -> None:
        """Go on to a decision where there is one, else decide as the odometry or the rail does."""
        decision = self._odometry.integrate(estimate)
        if isinstance(decision, bool):
            self._commit(decision)
            self.ended = not decision or self._next == len(self._drive)
            return
        forced = self._rail.forced(decision)
        if forced is None:
            self.decision, self.asked = decision, True
        else:
            self.decide(forced)

    def decide(self, keep: bool) -> None:
        """Keep or drop the frame, and earn what that is worth."""
        window = self._window() if self._reward.span is None else None
        self._commit(keep)
        worth = self._reward(*(window or self._recent()), keep)
        self._earned += worth if self.asked else 0.0
        self.decision = None
        self.ended = self._next == len(self._drive)

    def take_reward(self) -> float:
        """Return what was earned since it was taken last: a decision's worth, and the rail's."""
        earned, self._earned = self._earned, 0.0
        return earned

    def privileged(self) -> np.ndarray:
        """Return what only the critic sees (PRIVILEGED_SIZE,): the true motion, and the next.

        From the last keyframe to the newest frame, then frame by frame, in the trajectory's unit,
        each (t, quat_xyzw); past the end zeros, and a flag of 1. At last how good the trajectory
        is so far: one that is bad already has less to lose.
        """
        estimated, true = self._window()
        unit_m = _metres_per_unit(estimated[:, :3, 3], true[:, :3, 3])
        ahead = self._drive.T_truth_camera[self._next - 1:self._next + AHEAD]
        motions = np.concatenate([geometry.relative(true[-1:], true[-2:-1]),
                                  geometry.relative(ahead[:-1], ahead[1:])])
        told = np.zeros((1 + AHEAD, POSE), dtype=np.float32)
        told[:len(motions), :3] = motions[:, :3, 3] / unit_m
        told[:len(motions), 3:] = geometry.quat_xyzw_from_rotation(motions[:, :3, :3])
        return np.append(told, [np.float32(len(motions) < len(told)),
                                np.float32(self._reward.standing)])

    def _commit(self, keep: bool) -> None:
        self._odometry.commit(keep, {})
        self._trail.append(self._odometry.pending[-1])

    def _window(self) -> tuple[np.ndarray, np.ndarray]:
        """Return estimated and true poses (S, 4, 4) of the frames in the window."""
        window = self._odometry.window
        return (np.array([frame.T_world_camera for frame in window]),
                self._drive.T_truth_camera[[frame.index for frame in window]])

    def _recent(self) -> tuple[np.ndarray, np.ndarray]:
        """Return estimated and true poses (S, 4, 4) of the last input frames, as known now."""
        keyframes = np.concatenate([placed.keyframe.T_world_camera for placed in self._trail])
        offsets = np.concatenate([placed.T_keyframe_camera for placed in self._trail])
        return (keyframes.reshape(-1, 4, 4) @ offsets.reshape(-1, 4, 4),
                self._drive.T_truth_camera[self._next - len(self._trail):self._next])


def _metres_per_unit(estimated: np.ndarray, true: np.ndarray) -> float:
    """Return how much wider true positions (S, 3) are spread than estimated ones, 1 at rest."""
    estimated_spread, true_spread = (float(np.linalg.norm(positions - positions.mean(axis=0)))
                                     for positions in (estimated, true))
    if true_spread < STANDSTILL_M or estimated_spread == 0.0:
        return 1.0
    return true_spread / estimated_spread
