# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe-based feed-forward visual odometry: the method of the paper, step by step.

Each frame is encoded once (1), the backbone estimates the poses of its window relative to the
oldest keyframe, the anchor (2), their scale is aligned to the trajectory (3), they are chained to
the world (4), the window is observed (5), and the keyframe policy keeps or drops the frame (6).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import (
    LOST_VARIANCE,
    Backbone,
    Encoded,
    Estimate,
    Status,
    Stream,
    Window,
    WindowPrior,
    lost_estimate,
)
from kfvo_ros.camera import Camera
from kfvo_ros.images import to_grey
from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy, observe
from kfvo_ros.odometry.scale import ScaleAligner
from kfvo_ros.odometry.updates import FramePose, Keyframe, Step, Update
from kfvo_ros.odometry.window_prior import (
    WindowState,
    propagate_covariance,
    rotate_covariance,
    scale_poses,
    transform_points,
)
from kfvo_ros.sequences.base import Frame
from kfvo_ros.tracking.tracker import Tracker, Tracks
from kfvo_ros.utils.process import Stopwatch

WINDOW_SIZE = 8
MAX_LOST_FRAMES = 5
"""After this many lost frames in a row the window restarts at the last known pose, in the next
frame that is not blind."""
MAX_PENDING = 1000
"""Maximum of pending poses: a camera at rest adds no keyframes, so older poses become final."""


class KeyframeOdometry:
    """Monocular odometry over a sliding window of keyframes: `process` is the method.

    Feed the frames of one sequence in order; `finish` ends it. `scale_rule` None takes the
    backbone's default; without `with_covariance` all covariances are zero. A caller that batches
    the windows of many sequences runs the steps of `process` itself: `encode`, `integrate`,
    `commit`.
    """

    def __init__(self, backbone: Backbone, policy: KeyframePolicy,
                 scale_rule: str | None = None, window_size: int = WINDOW_SIZE,
                 with_covariance: bool = True) -> None:
        self.backbone = backbone
        self.policy = policy
        self.window_size = window_size
        self.scale = ScaleAligner(scale_rule or backbone.default_scale_rule)
        self._with_covariance = with_covariance
        self._stream: Stream | None = None
        self._tracker: Tracker | None = None
        self._keyframes: list[Keyframe] = []
        self._newest: Keyframe
        self._prior: WindowPrior | None = None
        self._input: Window | None = None
        self._state = WindowState()
        self._step = Step()
        self._pending: list[FramePose] = []
        self._final: list[FramePose] = []
        self._lost_in_a_row = 0
        self._frames_seen = 0
        self._started = False

    def process(self, frame: Frame) -> Update:
        """Estimate the pose of the next frame and return what it changed."""
        clock = Stopwatch()
        with clock('encode'):
            window = self.encode(frame)
        with clock('estimate'):
            estimate = self.backbone.estimate([window])[0] if window is not None else None
            step = self.integrate(estimate)
        with clock('decide'):
            keep = step.keep if step.decision is None else self.policy.decide(step.decision)
        return self.commit(keep, clock.durations)

    def encode(self, frame: Frame, encoded: Encoded | None = None) -> Window | None:
        """Encode the frame (step 1) and return its window.

        None for the first frame of a segment, and for a blind one.

        `encoded` is the frame's encoding where it exists already.
        """
        stream = self.open(frame.camera)
        encoded = encoded or stream.encode(frame)
        self._newest = Keyframe(encoded, self._track(frame, encoded), self._frames_seen,
                                self._state.T_world_latest, np.zeros((6, 6)))
        self._frames_seen += 1
        if self._lost_in_a_row >= MAX_LOST_FRAMES and not encoded.blind:
            self._clear_window()
        self._input = self._make_input(stream) if self._keyframes else None
        return None if encoded.blind else self._input

    def integrate(self, estimate: Estimate | None) -> Step:
        """Align, chain and observe (steps 3 to 5); `estimate` is None without a window."""
        if self._newest.encoded.blind:
            self._step = self._hold_blind()
        elif estimate is None:
            self._step = self._start_segment()
        elif estimate.status is Status.LOST:
            self._step = self._hold(estimate)
        else:
            self._step = self._advance(estimate)
        return self._step

    def commit(self, keep: bool, durations: dict[str, float]) -> Update:
        """Keep or drop the newest frame (step 6) and return what it changed."""
        newest, step = self._newest, self._step
        self._pending.append(self._keep() if keep else self._drop())
        self._final += self._pending[:-MAX_PENDING]
        del self._pending[:-MAX_PENDING]
        final = tuple(self._final)
        self._final.clear()
        return Update(newest.encoded.stamp_ns, newest.T_world_camera, step.covariance,
                      step.window_covariance, step.status, keep, final, self._state.points,
                      durations, step.intrinsics, step.durations)

    def finish(self) -> tuple[FramePose, ...]:
        """Return the pending frames; their poses are final now."""
        final = (*self._final, *self._pending)
        self._final.clear()
        self._pending.clear()
        return final

    def open(self, camera: Camera | None) -> Stream:
        """Return the stream of the sequence; the first call opens it."""
        if self._stream is None:
            self._stream = self.backbone.open(camera)
        return self._stream

    @property
    def window(self) -> tuple[Keyframe, ...]:
        """The keyframes, oldest first, and the newest frame."""
        return (*self._keyframes, self._newest)

    @property
    def pending(self) -> tuple[FramePose, ...]:
        """Frames whose poses may still change, in input order."""
        return tuple(self._pending)

    def _track(self, frame: Frame, encoded: Encoded) -> Tracks:
        """Return the tracks of the backbone, else own ones if the policy needs them, else none."""
        if encoded.tracks is not None:
            return encoded.tracks
        if not self.policy.needs_tracks:
            return Tracks()
        if self._tracker is None:
            self._tracker = Tracker(frame.camera)
        return self._tracker.track(to_grey(frame.image))

    def _make_input(self, stream: Stream) -> Window:
        """Return the backbone's input for the present window."""
        self._prior = self._state.prior_of(self._keyframes)
        return Window(stream, tuple(frame.encoded for frame in self.window), self._prior)

    def _start_segment(self) -> Step:
        """Start a window at the newest frame: at the origin, or where tracking was lost.

        The motion while lost is unobserved: the last, large covariance stays.
        """
        newest = self._newest
        if not self._started:
            self._started = True
            return Step()
        newest.covariance = self._step.covariance
        self._state = WindowState(newest.T_world_camera, memory=self._state.memory)
        return replace(self._step, status=Status.LOST, durations={}, decision=None, keep=True)

    def _hold_blind(self) -> Step:
        """Keep the latest pose for a blind frame, which the backbone does not see."""
        if self._input is not None:
            return self._hold(lost_estimate(self._input))
        covariance = LOST_VARIANCE * np.eye(6)
        self._newest.covariance = covariance
        return Step(Status.LOST, covariance, covariance, keep=False)

    def _hold(self, estimate: Estimate) -> Step:
        """Keep the latest pose for a lost frame, with the estimate's large covariance."""
        self._lost_in_a_row += 1
        window_covariance = self._propagate_covariance(estimate, -1, 1.0)
        self._update_state(estimate, 1.0, self._state.memory_scale)
        return Step(estimate.status, self._newest.covariance, window_covariance,
                    estimate.intrinsics, estimate.durations, keep=False)

    def _advance(self, estimate: Estimate) -> Step:
        """Align the scale of the window, chain its poses, and observe it once it is full."""
        self._lost_in_a_row = 0
        scale = self.scale.align(estimate, self._prior)
        self._chain(scale_poses(estimate.T_anchor_frame, scale))
        self._propagate_covariance(estimate, 1, scale)  # of the next anchor
        window_covariance = self._propagate_covariance(estimate, -1, scale)
        self._update_state(estimate, scale, scale)
        full = len(self._keyframes) == self.window_size - 1
        return Step(estimate.status, self._newest.covariance, window_covariance,
                    estimate.intrinsics, estimate.durations,
                    self._observe(estimate) if full else None)

    def _chain(self, T_anchor_frame: np.ndarray) -> None:
        """Step 4: overwrite the poses of all frames of the window except the anchor."""
        poses = self._keyframes[0].T_world_camera @ T_anchor_frame
        for keyframe, pose in zip(self.window[1:], poses[1:], strict=True):
            keyframe.T_world_camera = pose

    def _propagate_covariance(self, estimate: Estimate, index: int, scale: float) -> np.ndarray:
        """Set the covariance of a frame of the window; return its part relative to the anchor.

        Both are (6, 6) in world axes and trajectory units. Call it after `_chain`.
        """
        if not self._with_covariance:
            return self._step.window_covariance
        anchor, frame = self._keyframes[0], self.window[index]
        relative = rotate_covariance(estimate.covariance[index], anchor.T_world_camera, scale)
        offset = frame.T_world_camera[:3, 3] - anchor.T_world_camera[:3, 3]
        frame.covariance = propagate_covariance(relative, anchor.covariance, offset)
        return relative

    def _update_state(self, estimate: Estimate, scale: float, memory_scale: float) -> None:
        """Store the state for the prior of the next window."""
        points = transform_points(estimate.points, self._keyframes[0].T_world_camera, scale)
        self._state = WindowState(self._newest.T_world_camera, points, estimate.memory,
                                  memory_scale)

    def _observe(self, estimate: Estimate) -> DecisionInput:
        """Step 5: return the input of the policy."""
        frames, last = self.window, self._keyframes[-1]
        observation = observe([frame.encoded.descriptor for frame in frames],
                              np.array([frame.T_world_camera for frame in frames]),
                              estimate.signals)
        return DecisionInput(observation, last.tracks, self._newest.tracks,
                             self._newest.index - last.index)

    def _keep(self) -> FramePose:
        """Add the newest frame to the window; when it is full the anchor leaves."""
        if len(self._keyframes) == self.window_size - 1:
            self._retire(self._keyframes.pop(0))
            anchor = self._keyframes[0]
            # Poses are fed back: `invert` transposes the rotation, so a departure from
            # orthonormality grows two- to threefold per window unless it is removed here.
            anchor.T_world_camera = geometry.orthonormalise(anchor.T_world_camera)
        self._keyframes.append(self._newest)
        return FramePose(self._newest.encoded.stamp_ns, self._newest, np.eye(4), True)

    def _drop(self) -> FramePose:
        """Drop the newest frame: its pose stays relative to the last keyframe.

        Blind frames before the first keyframe are at the origin.
        """
        newest = self._newest
        last = self._keyframes[-1] if self._keyframes else newest
        self._release(newest)
        return FramePose(newest.encoded.stamp_ns, last,
                         geometry.relative(last.T_world_camera, newest.T_world_camera), False)

    def _retire(self, keyframe: Keyframe) -> None:
        """Release a keyframe that leaves the window; frames up to those on it become final."""
        self._release(keyframe)
        count = 0
        while count < len(self._pending) and self._pending[count].keyframe.index <= keyframe.index:
            count += 1
        self._final += self._pending[:count]
        del self._pending[:count]

    def _clear_window(self) -> None:
        """Empty the window; the next frame starts a new one at the last known pose."""
        self._lost_in_a_row = 0
        for keyframe in self._keyframes:
            self._retire(keyframe)
        self._keyframes.clear()

    def _release(self, frame: Keyframe) -> None:
        """Free the memory that the backbone holds for a frame."""
        if self._stream is not None:
            self._stream.release(frame.encoded)
