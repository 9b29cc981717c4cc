# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe-based feed-forward visual odometry: the method, one step after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import (
    Backbone,
    Encoded,
    Estimate,
    Points,
    Status,
    Stream,
    Window,
    WindowPrior,
)
from kfvo_ros.camera import Camera
from kfvo_ros.images import to_grey
from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy, observe
from kfvo_ros.odometry.scale import ScaleAligner
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
"""After so many lost frames in a row the window starts anew where the camera was last seen."""
MAX_PENDING = 1000
"""A camera at rest adds no keyframes: when more frames wait, the oldest are final as they are."""


@dataclass
class Keyframe:
    """A frame in the window; its pose T_world_camera is overwritten by every window it is in.

    ``covariance`` (6, 6) is the pose's in the world, translation first.
    """

    encoded: Encoded
    tracks: Tracks
    index: int
    T_world_camera: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class FramePose:
    """An input frame: where it is, told from the keyframe it hangs on.

    The pose follows the keyframe's refinement and is final when the keyframe leaves the window.
    """

    stamp_ns: int
    keyframe: Keyframe
    T_keyframe_camera: np.ndarray
    is_keyframe: bool

    @property
    def T_world_camera(self) -> np.ndarray:
        """Return the latest pose (4, 4) in trajectory units."""
        return self.keyframe.T_world_camera @ self.T_keyframe_camera


@dataclass(frozen=True)
class Update:
    """What one input frame changed.

    ``T_world_camera`` (4, 4) is the estimate at arrival, ``covariance`` (6, 6) its covariance
    in the world, translation first, and ``window_covariance`` the part that arose in this
    window; ``final`` are the frames whose poses became final, in input order, to be read at
    once: of a camera at rest they are let go while their keyframe is still in the window;
    ``points`` of the window in the world, None without;
    ``durations`` [s] of the steps encode, estimate, decide; ``intrinsics`` K (3, 3) [px] where
    the backbone estimates them; ``parts`` [s] of these steps, where it tells them.
    """

    stamp_ns: int
    T_world_camera: np.ndarray
    covariance: np.ndarray
    window_covariance: np.ndarray
    status: Status
    is_keyframe: bool
    final: tuple[FramePose, ...]
    points: Points | None
    durations: dict[str, float]
    intrinsics: np.ndarray | None = None
    parts: Mapping[str, float] = field(default_factory=dict)

    @property
    def median_depth(self) -> float | None:
        """Return how far away the points are [trajectory units], None without."""
        if self.points is None or not len(self.points.ids):
            return None
        return float(np.median(np.linalg.norm(
            self.points.positions - self.T_world_camera[:3, 3], axis=1)))


class KeyframeOdometry:
    """Feed frames in order, get poses: `process` is the method, `finish` ends the sequence.

    `scale_rule` None takes the backbone's own; without `with_covariance` all covariances stay
    zero. A caller that batches many sequences into one backbone call runs the steps of `process`
    itself: `begin`, `integrate`, `commit`.
    """

    def __init__(self, backbone: Backbone, policy: KeyframePolicy,
                 scale_rule: str | None = None, window_size: int = WINDOW_SIZE,
                 with_covariance: bool = True) -> None:
        self.backbone = backbone
        self.policy = policy
        self.window_size = window_size
        self._with_covariance = with_covariance
        self.scale = ScaleAligner(scale_rule or backbone.default_scale_rule)
        self._stream: Stream | None = None
        self._tracker: Tracker | None = None
        self._keyframes: list[Keyframe] = []
        self._newest: Keyframe
        self._pending: list[FramePose] = []
        self._final: list[FramePose] = []
        self._known = WindowState()
        self._previous: WindowPrior | None = None
        self._status = Status.OK
        self._covariance = self._window_covariance = np.zeros((6, 6))
        self._intrinsics: np.ndarray | None = None
        self._parts: Mapping[str, float] = {}
        self._lost_in_a_row = 0
        self._frames_seen = 0

    def process(self, frame: Frame) -> Update:
        """Take in the next frame and return what it changed."""
        clock = Stopwatch()
        with clock('encode'):
            window = self.begin(frame)
        with clock('estimate'):
            estimate = self.backbone.estimate([window])[0] if window is not None else None
            decision = self.integrate(estimate)
        with clock('decide'):
            keep = decision if isinstance(decision, bool) else self.policy.decide(decision)
        return self.commit(keep, clock.durations)

    def open(self, camera: Camera | None) -> Stream:
        """Return the sequence's stream; its first frame opens it."""
        if self._stream is None:
            self._stream = self.backbone.open(camera)
        return self._stream

    def begin(self, frame: Frame, encoded: Encoded | None = None) -> Window | None:
        """Encode the frame (step 1); return its window, None when there is nothing before it.

        A frame that was encoded before need not be again.
        """
        stream = self.open(frame.camera)
        encoded = encoded or stream.encode(frame)
        self._newest = Keyframe(encoded, self._track(frame, encoded), self._frames_seen,
                                self._known.T_world_latest, self._known.covariance)
        self._frames_seen += 1
        if self._lost_in_a_row >= MAX_LOST_FRAMES:
            self._start_anew()
        if not self._keyframes:
            return None
        self._previous = self._known.seen_from(self._keyframes)
        return Window(stream, tuple(frame.encoded for frame in self.window),
                      self._previous)

    def integrate(self, estimate: Estimate | None) -> DecisionInput | bool:
        """Align, chain and observe (steps 3 to 5); return the decision's input, or the decision.

        There is nothing to decide while the window fills (keep) or for a lost frame (drop).
        """
        if estimate is None:
            # The first frame is the world; that of a later start is where the last one was lost,
            # and as doubtful: nobody saw how far the camera went meanwhile.
            self._newest.covariance = self._covariance
            self._known = WindowState(self._newest.T_world_camera, self._covariance,
                                      memory=self._known.memory)
            self._status = Status.OK if self._newest.index == 0 else Status.LOST
            self._parts = {}
            return True
        scale, memory_scale = 1.0, self._known.memory_scale
        if estimate.status is not Status.LOST:
            scale = memory_scale = self.scale.align(estimate, self._previous)
            self._chain(scale_poses(estimate.T_anchor_frame, scale))
        self._lost_in_a_row = self._lost_in_a_row + 1 if estimate.status is Status.LOST else 0
        T_world_anchor = self._keyframes[0].T_world_camera
        self._status, self._intrinsics = estimate.status, estimate.intrinsics
        self._parts = estimate.durations
        if self._with_covariance:
            self._doubt(estimate, scale)
        self._known = WindowState(
            self._newest.T_world_camera,
            self._known.covariance if estimate.status is Status.LOST else self._newest.covariance,
            transform_points(estimate.points, T_world_anchor, scale), estimate.memory, memory_scale)
        if estimate.status is Status.LOST or len(self._keyframes) < self.window_size - 1:
            return estimate.status is not Status.LOST
        return self._decision(estimate)

    def commit(self, keep: bool, durations: dict[str, float]) -> Update:
        """Keep or drop the newest frame (step 6) and return what it changed."""
        newest = self._newest
        if keep:
            if len(self._keyframes) == self.window_size - 1:
                self._retire(self._keyframes.pop(0))
                anchor = self._keyframes[0]
                # Products of many drift away from a rotation; all that follow start from this.
                anchor.T_world_camera = geometry.orthonormalise(anchor.T_world_camera)
            self._keyframes.append(newest)
            placed = FramePose(newest.encoded.stamp_ns, newest, np.eye(4), True)
        else:
            last = self._keyframes[-1]
            placed = FramePose(newest.encoded.stamp_ns, last,
                               geometry.relative(last.T_world_camera, newest.T_world_camera), False)
            self._release(newest)
        self._pending.append(placed)
        self._final += self._pending[:-MAX_PENDING]
        del self._pending[:-MAX_PENDING]
        final = tuple(self._final)
        self._final.clear()
        return Update(newest.encoded.stamp_ns, newest.T_world_camera, self._covariance,
                      self._window_covariance, self._status, keep, final,
                      self._known.points, durations, self._intrinsics, self._parts)

    def finish(self) -> tuple[FramePose, ...]:
        """Return the frames whose poses were not final yet; they are now."""
        final = (*self._final, *self._pending)
        self._final.clear()
        self._pending.clear()
        return final

    @property
    def window(self) -> tuple[Keyframe, ...]:
        """The keyframes, oldest first, and the newest frame."""
        return (*self._keyframes, self._newest)

    @property
    def pending(self) -> tuple[FramePose, ...]:
        """Frames whose poses may still change, in input order."""
        return tuple(self._pending)

    def _track(self, frame: Frame, encoded: Encoded) -> Tracks:
        """Return the backbone's tracks, our own if only the policy asks, or none."""
        if encoded.tracks is not None:
            return encoded.tracks
        if not self.policy.needs_tracks:
            return Tracks()
        if self._tracker is None:
            self._tracker = Tracker(frame.camera)
        return self._tracker.track(to_grey(frame.image))

    def _chain(self, T_anchor_frame: np.ndarray) -> None:
        """Step 4: overwrite the poses of all frames in the window but the anchor's."""
        poses = self._keyframes[0].T_world_camera @ T_anchor_frame
        for keyframe, pose in zip((*self._keyframes[1:], self._newest), poses[1:], strict=True):
            keyframe.T_world_camera = pose

    def _doubt(self, estimate: Estimate, scale: float) -> None:
        """Give the newest frame, and the anchor to come, their covariances in the world."""
        anchor, frames = self._keyframes[0], self.window
        for index in (-1,) if estimate.status is Status.LOST else (1, -1):
            own = rotate_covariance(estimate.covariance[index], anchor.T_world_camera, scale)
            offset = frames[index].T_world_camera[:3, 3] - anchor.T_world_camera[:3, 3]
            frames[index].covariance = propagate_covariance(own, anchor.covariance, offset)
        self._covariance, self._window_covariance = self._newest.covariance, own

    def _decision(self, estimate: Estimate) -> DecisionInput:
        """Step 5: what the policy sees."""
        frames, last = self.window, self._keyframes[-1]
        observation = observe([frame.encoded.descriptor for frame in frames],
                              np.array([frame.T_world_camera for frame in frames]),
                              estimate.signals)
        return DecisionInput(observation, last.tracks, self._newest.tracks,
                             self._newest.index - last.index)

    def _retire(self, keyframe: Keyframe) -> None:
        """Let a keyframe leave the window; the frames that hang on it are final now."""
        self._release(keyframe)
        count = 0
        while count < len(self._pending) and self._pending[count].keyframe is keyframe:
            count += 1
        self._final += self._pending[:count]
        del self._pending[:count]

    def _start_anew(self) -> None:
        """Empty the window: the next frame starts another one where the camera was last seen."""
        self._lost_in_a_row = 0
        for keyframe in self._keyframes:
            self._retire(keyframe)
        self._keyframes.clear()

    def _release(self, frame: Keyframe) -> None:
        """Let the backbone free what it holds for a frame."""
        if self._stream is not None:
            self._stream.release(frame.encoded)
