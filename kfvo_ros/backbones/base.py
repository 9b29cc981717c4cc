# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The contract between a backbone and the odometry: read this to add a model.

A backbone turns a window of frames into poses relative to its first frame, the anchor. It is
told nothing about keyframe policies, trajectories or scale alignment. One `Backbone` serves
many `Stream`s; all memory of one sequence lives in its stream, so a reset is a new stream.
Sequences that go in step are encoded and estimated in one call for all, of which a model may
make one batch.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.sequences.base import Frame
from kfvo_ros.tracking.tracker import Tracks

LOST_VARIANCE = 1e2
"""Variance of each component of a pose that is only a guess."""


class Status(str, Enum):
    """What a backbone says of the newest frame of a window."""

    OK = 'ok'
    HELD = 'held'
    """The camera stands still or only turns: rotation is seen, translation is not."""
    LOST = 'lost'
    """The frame could not be placed; its pose is a guess."""


@dataclass(frozen=True)
class Encoded:
    """One frame after `Stream.encode`.

    ``descriptor`` (D,) float32 summarises the image for the keyframe policy. ``payload`` is the
    backbone's own. ``tracks`` are offered by backbones that track anyway.
    """

    stamp_ns: int
    descriptor: np.ndarray
    payload: Any = None
    tracks: Tracks | None = None


@dataclass(frozen=True)
class Points:
    """Scene points by track id: ``positions`` (P, 3) in the anchor, in the estimate's unit.

    ``information`` (P,) is the inverse variance of the logarithm of a point's depth, for tracks
    that are off by one pixel.
    """

    ids: np.ndarray
    positions: np.ndarray
    information: np.ndarray

    @cached_property
    def depths(self) -> np.ndarray:
        """Distances (P,) from the anchor's centre."""
        return np.linalg.norm(self.positions, axis=1)


@dataclass(frozen=True)
class WindowPrior:
    """What earlier windows said of this one: a hint that a stateless backbone ignores.

    ``T_anchor_frame`` (S - 1, 4, 4) are the keyframes' poses in the present anchor and
    ``points`` the latest points in it, both in trajectory units. ``T_anchor_latest`` (4, 4) is
    the pose of the frame before the new one, kept or not. ``memory`` is what the last estimate
    put there, with ``memory_scale`` = trajectory units per unit of that estimate.
    """

    T_anchor_frame: np.ndarray
    T_anchor_latest: np.ndarray
    points: Points | None
    memory: Any = None
    memory_scale: float = 1.0


@dataclass(frozen=True)
class Window:
    """Keyframes, oldest first, and the new frame last: ``frames`` (S), S >= 2."""

    stream: Stream
    frames: tuple[Encoded, ...]
    previous: WindowPrior | None = None


@dataclass(frozen=True)
class Estimate:
    """What a backbone says of one window.

    ``T_anchor_frame`` (S, 4, 4) float64, the first exactly identity, translations in one
    unit per window; ``make_covariance`` returns what ``covariance`` is; ``points`` or None;
    ``signals`` (len(signal_names),) float32 for the policy; ``status`` of the newest frame;
    ``memory`` comes back in the next `WindowPrior`; ``intrinsics`` K (3, 3) of the newest image [px]
    from those that estimate them; ``durations`` [s] of parts of the call that people compare,
    such as ``head``, of a batch the window's share.
    """

    T_anchor_frame: np.ndarray
    make_covariance: Callable[[], np.ndarray]
    points: Points | None
    signals: np.ndarray
    status: Status = Status.OK
    memory: Any = None
    intrinsics: np.ndarray | None = None
    durations: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariances (S, 6, 6) of poses in the anchor, translation before rotation [rad].

        They take their time, which trainings do without.
        """
        return self.make_covariance()


def lost(window: Window, signal_count: int = 0, memory: Any = None) -> Estimate:
    """Return the known poses, and the last frame's for the new one, which could not be placed.

    `memory` is that of a stream without an estimate so far.
    """
    frames = len(window.frames)
    T_anchor_frame = np.tile(np.eye(4), (frames, 1, 1))
    points = None
    if window.previous is not None:
        T_anchor_frame[:-1] = window.previous.T_anchor_frame
        T_anchor_frame[-1] = window.previous.T_anchor_latest
        points, memory = window.previous.points, window.previous.memory
    covariance = np.tile(LOST_VARIANCE * np.eye(6), (frames, 1, 1))
    covariance[0] = 0.0
    return Estimate(T_anchor_frame, lambda: covariance, points,
                    np.zeros(signal_count, dtype=np.float32), Status.LOST, memory)


class Stream(ABC):
    """All memory of one sequence: tracks, caches."""

    @abstractmethod
    def encode(self, frame: Frame) -> Encoded:
        """Take in the next input frame, kept or not, in order; once per frame."""

    def release(self, encoded: Encoded) -> None:
        """Free what is held for a frame that left the window."""


class Backbone(ABC):
    """A model that places the frames of a window."""

    name: str
    needs_camera: bool = True
    offers_tracks: bool = False
    descriptor_size: int
    signal_names: tuple[str, ...] = ()
    default_scale_rule: str = 'translation'
    unit: str = "the first window's own"
    """What a trajectory's unit of length is, in words."""

    @abstractmethod
    def open(self, camera: Camera | None) -> Stream:
        """Start a sequence; raises KfvoError when the camera does not fit the model."""

    def encode(self, seen: Sequence[tuple[Stream, Frame]]) -> list[Encoded]:
        """Take in the next frame of many streams in one call: `Stream.encode` for each."""
        return [stream.encode(frame) for stream, frame in seen]

    @abstractmethod
    def estimate(self, windows: Sequence[Window]) -> list[Estimate]:
        """Place the frames of many windows in one call; no side effects."""

    def condition(self) -> dict[str, str]:
        """Return what people may want to see of the running model, by name."""
        return {'device': 'cpu'}
