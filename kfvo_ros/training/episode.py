# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One sequence as a Markov decision process: keep a frame or drop it (paper, section IV-A)."""

from __future__ import annotations

from collections import deque

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Backbone, Encoded, Estimate, Stream, Window
from kfvo_ros.keyframes.base import POSE_SIZE, DecisionInput
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.keyframes.heuristics import EveryFrame
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.odometry.updates import FramePose
from kfvo_ros.sequences.base import Frame
from kfvo_ros.training.encoded_sequence import EncodedSequence
from kfvo_ros.training.rewards import STANDSTILL_M, Reward

LOOKAHEAD = 2
"""True motions after the newest frame that the critic sees."""
PRIVILEGED_SIZE = (1 + LOOKAHEAD) * POSE_SIZE + 2


class Episode:
    """Runs the odometry over a sequence and stops at every decision of the policy.

    ``decision`` is the policy's input at such a stop; it is None before the first one and once
    the episode ``ended``, at the last frame or with a lost camera. Decisions that the guard
    forces are not the policy's: their reward adds to that of the decision before, and counts
    for nothing until the episode ``reached_decision``. The caller runs the backbone: encode
    `unencoded_frame`, `begin`, estimate the window, `integrate`, until there is a decision.
    """

    def __init__(self, sequence: EncodedSequence, backbone: Backbone, scale_rule: str,
                 window_size: int, guard: KeyframeGuard, reward: Reward) -> None:
        self._sequence, self._guard, self._reward = sequence, guard, reward
        self._odometry = KeyframeOdometry(backbone, EveryFrame(), scale_rule, window_size,
                                          with_covariance=False)
        self._latest_frames: deque[FramePose] = deque(maxlen=reward.span or 0)
        self._next_index = 0
        self.decision: DecisionInput | None = None
        self.ended = False
        self.reached_decision = False
        self._pending_reward = 0.0

    def unencoded_frame(self) -> tuple[Stream, Frame] | None:
        """Return the next frame and its stream, None for a frame that is encoded already."""
        if self._sequence.encoded[self._next_index] is not None:
            return None
        frame = self._sequence.frames[self._next_index]
        return self._odometry.open(frame.camera), frame

    def begin(self, encoded: Encoded | None = None) -> Window | None:
        """Take in the next frame; return the window to estimate, None for the first frame."""
        index, self._next_index = self._next_index, self._next_index + 1
        return self._odometry.encode(self._sequence.frames[index],
                                     encoded or self._sequence.encoded[index])

    def integrate(self, estimate: Estimate | None) -> None:
        """Add the window's estimate; set ``decision``, or decide as odometry or guard force."""
        step = self._odometry.integrate(estimate)
        if step.decision is None:
            self._commit(step.keep)
            self.ended = not step.keep or self._at_end
            return
        forced = self._guard.forced(step.decision)
        if forced is None:
            self.decision, self.reached_decision = step.decision, True
        else:
            self.decide(forced)

    def decide(self, keep: bool) -> None:
        """Keep or drop the newest frame, and add the reward of this decision."""
        if self._reward.span is None:  # of the window that the decision was made on
            estimated, true = self._window_poses()
            self._commit(keep)
        else:
            self._commit(keep)
            estimated, true = self._latest_poses()
        reward = self._reward(estimated, true, keep)
        if self.reached_decision:
            self._pending_reward += reward
        self.decision = None
        self.ended = self._at_end

    def pop_reward(self) -> float:
        """Return the reward since the last call: the policy's decision and forced ones."""
        reward, self._pending_reward = self._pending_reward, 0.0
        return reward

    def privileged_observation(self) -> np.ndarray:
        """Return the critic's additional input (PRIVILEGED_SIZE,), float32.

        True motions, each (t, quat_xyzw) in trajectory units: T_newest_keyframe of the last
        keyframe, then LOOKAHEAD motions from frame to frame; past the end of the sequence zeros
        and a flag of 1. The last number is the trajectory's quality (`Reward.quality`): a bad
        trajectory has less to lose.
        """
        estimated, true = self._window_poses()
        unit_m = _metres_per_unit(estimated[:, :3, 3], true[:, :3, 3])
        ahead = self._sequence.T_truth_camera[self._next_index - 1:self._next_index + LOOKAHEAD]
        motions = np.concatenate([geometry.relative(true[-1:], true[-2:-1]),
                                  geometry.relative(ahead[:-1], ahead[1:])])
        numbers = np.zeros((1 + LOOKAHEAD, POSE_SIZE), dtype=np.float32)
        numbers[:len(motions), :3] = motions[:, :3, 3] / unit_m
        numbers[:len(motions), 3:] = geometry.quat_xyzw_from_rotation(motions[:, :3, :3])
        return np.append(numbers, [np.float32(len(motions) < len(numbers)),
                                   np.float32(self._reward.quality)])

    @property
    def _at_end(self) -> bool:
        return self._next_index == len(self._sequence)

    def _commit(self, keep: bool) -> None:
        self._odometry.commit(keep, {})
        self._latest_frames.append(self._odometry.pending[-1])

    def _window_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return estimated and true poses (S, 4, 4) of the frames in the window."""
        window = self._odometry.window
        return (np.array([frame.T_world_camera for frame in window]),
                self._sequence.T_truth_camera[[frame.index for frame in window]])

    def _latest_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return present estimates and true poses (S, 4, 4) of the latest input frames."""
        keyframes = np.concatenate([each.keyframe.T_world_camera for each in self._latest_frames])
        offsets = np.concatenate([each.T_keyframe_camera for each in self._latest_frames])
        first = self._next_index - len(self._latest_frames)
        return (keyframes.reshape(-1, 4, 4) @ offsets.reshape(-1, 4, 4),
                self._sequence.T_truth_camera[first:self._next_index])


def _metres_per_unit(estimated: np.ndarray, true: np.ndarray) -> float:
    """Return the ratio of the spreads of true and estimated positions (S, 3), 1 at rest."""
    estimated_spread, true_spread = (float(np.linalg.norm(positions - positions.mean(axis=0)))
                                     for positions in (estimated, true))
    if true_spread < STANDSTILL_M or estimated_spread == 0.0:
        return 1.0
    return true_spread / estimated_spread
