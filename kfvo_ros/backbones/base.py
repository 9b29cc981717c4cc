# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The contract between a model and the odometry: read this to add a backbone.

A backbone estimates the camera poses of a window of frames relative to its first frame, the
*anchor*. Scale alignment, trajectories and keyframe policies are the odometry's; a backbone
knows none of them.

* `Backbone` holds what all sequences share, such as weights. It has no state of a sequence.
* `Stream` holds the state of one sequence, such as tracks and caches. A reset is a new stream.
* `Backbone.encode` and `Backbone.estimate` take many streams in one call, which a model may
  compute as one batch.

For each input frame the odometry calls `encode` once, builds a `Window` of the current keyframes
and the new frame, calls `estimate`, and calls `Stream.release` for each frame that leaves the
window. To add a backbone, subclass `Stream` and `Backbone`, and construct it in
`odometry.factory.make_backbone`.
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
"""Variance of each pose component of a lost frame [estimate units^2 and rad^2]."""


class Status(str, Enum):
    """Quality of the newest frame's pose."""

    OK = 'ok'
    HELD = 'held'
    """Standstill or pure rotation: the rotation is observed, the translation is not."""
    LOST = 'lost'
    """The pose could not be estimated; it is that of the frame before."""


@dataclass(frozen=True)
class Encoded:
    """Result of `Stream.encode` for one frame.

    ``descriptor`` (D,) float32 summarises the image for the keyframe policy. ``payload`` is
    private to the backbone. ``tracks`` are set by backbones that track features. A ``blind`` frame
    shows nothing by which it could be located: it is LOST without an estimate, and no keyframe.
    """

    stamp_ns: int
    descriptor: np.ndarray
    payload: Any = None
    tracks: Tracks | None = None
    blind: bool = False


@dataclass(frozen=True)
class Points:
    """Scene points by track id: ``ids`` (P,) int64, ``positions`` (P, 3) in the anchor frame.

    ``information`` (P,) is the inverse variance of the logarithm of each depth, for a pixel noise
    of 1 px.
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
    """Poses and points of earlier windows, in the current anchor and in trajectory units.

    A stateless backbone ignores them.

    ``T_anchor_frame`` (S - 1, 4, 4) are the keyframes' poses, the first the identity;
    ``T_anchor_latest`` (4, 4) is the pose of the input frame before the new one, keyframe or not;
    ``points`` are the latest points, None without. ``memory`` is that of the last `Estimate`, and
    ``memory_scale`` the trajectory units per unit of that estimate.
    """

    T_anchor_frame: np.ndarray
    T_anchor_latest: np.ndarray
    points: Points | None
    memory: Any = None
    memory_scale: float = 1.0


@dataclass(frozen=True)
class Window:
    """Input of `Backbone.estimate`: ``frames`` (S >= 2), keyframes oldest first, then the new one.

    ``prior`` is None before the first estimate of a stream.
    """

    stream: Stream
    frames: tuple[Encoded, ...]
    prior: WindowPrior | None = None


@dataclass(frozen=True)
class Estimate:
    """Output of `Backbone.estimate` for one window of S frames.

    * ``T_anchor_frame`` (S, 4, 4) float64: poses, the first exactly the identity; all translations
      of a window share one unit, which may differ between windows.
    * ``make_covariance``: computes ``covariance``.
    * ``points``: scene points in the unit of the poses, None for backbones without points.
    * ``signals`` (len(signal_names),) float32: inputs of the keyframe policy.
    * ``status`` of the newest frame. A lost frame leaves trajectory and scale as they are.
    * ``memory``: state for the next window of this stream, passed back in `WindowPrior`.
    * ``intrinsics`` K (3, 3) of the newest image [px], from backbones that estimate them.
    * ``durations`` [s] of parts of the call, by name; each window's share of a batch.
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
        """Pose covariances (S, 6, 6) in the anchor frame, translation first, rotation in rad.

        Computed on first access: training never reads them.
        """
        return self.make_covariance()


def lost_estimate(window: Window, signal_count: int = 0, memory: Any = None) -> Estimate:
    """Return the prior as an estimate of status LOST, the new frame at the latest pose.

    `memory` is used when the window has no prior.
    """
    frames = len(window.frames)
    T_anchor_frame = np.tile(np.eye(4), (frames, 1, 1))
    points = None
    if window.prior is not None:
        T_anchor_frame[:-1] = window.prior.T_anchor_frame
        T_anchor_frame[-1] = window.prior.T_anchor_latest
        points, memory = window.prior.points, window.prior.memory
    covariance = np.tile(LOST_VARIANCE * np.eye(6), (frames, 1, 1))
    covariance[0] = 0.0
    return Estimate(T_anchor_frame, lambda: covariance, points,
                    np.zeros(signal_count, dtype=np.float32), Status.LOST, memory)


class Stream(ABC):
    """State of one sequence."""

    @abstractmethod
    def encode(self, frame: Frame) -> Encoded:
        """Encode the next input frame; called once for each frame, in order, keyframe or not."""

    def release(self, encoded: Encoded) -> None:
        """Free what is held for a frame that left the window."""


class Backbone(ABC):
    """A model that estimates the poses of a window's frames."""

    name: str
    """Value of the option ``backbone``; policies are trained for one name."""
    needs_camera: bool = True
    """Whether `open` raises KfvoError without a camera."""
    offers_tracks: bool = False
    """Whether ``Encoded.tracks`` are set; else the odometry tracks when a policy asks for it."""
    descriptor_size: int
    """Size D of ``Encoded.descriptor``."""
    signal_names: tuple[str, ...] = ()
    """Names of ``Estimate.signals``, in order."""
    default_scale_rule: str = 'translation'
    """Scale alignment between windows unless another is chosen; see `odometry.scale`."""
    unit: str = "the first window's own"
    """The trajectory's unit of length, in words."""

    @abstractmethod
    def open(self, camera: Camera | None) -> Stream:
        """Start a sequence; raises KfvoError when the camera does not fit the model."""

    def encode(self, batch: Sequence[tuple[Stream, Frame]]) -> list[Encoded]:
        """Encode the next frame of each stream in one call; equals `Stream.encode` for each."""
        return [stream.encode(frame) for stream, frame in batch]

    @abstractmethod
    def estimate(self, windows: Sequence[Window]) -> list[Estimate]:
        """Estimate many windows in one call, without side effects."""

    def device_info(self) -> dict[str, str]:
        """Return device and precision for logs, diagnostics and ``summary.json``, by name."""
        return {'device': 'cpu'}
