# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Geometric backbone: `encode` tracks features, `estimate` solves the window."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from kfvo_ros.backbones.base import (
    Backbone,
    Encoded,
    Estimate,
    Status,
    Stream,
    Window,
    lost_estimate,
)
from kfvo_ros.backbones.geometric.initialisation import Initialiser
from kfvo_ros.backbones.geometric.keyframe_history import (
    KeyframeHistory,
    history_of,
    select_history,
)
from kfvo_ros.backbones.geometric.numba_utils import compile_entry_points
from kfvo_ros.backbones.geometric.observations import (
    MIN_TRACKS,
    FrameTracks,
    build_track_table,
)
from kfvo_ros.backbones.geometric.rolling_shutter import RollingShutter
from kfvo_ros.backbones.geometric.self_calibration import MIN_NEW_SHARE, IntrinsicsFilter
from kfvo_ros.backbones.geometric.signals import SIGNAL_NAMES, compute_signals, measure_motion
from kfvo_ros.backbones.geometric.window import Solution, solve
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.images import to_grey
from kfvo_ros.sequences.base import Frame
from kfvo_ros.tracking import tracker
from kfvo_ros.tracking.tracker import FEATURES, Tracker

THUMBNAIL = (8, 6)
"""Width and height of the descriptor."""


class GeometricStream(Stream):
    """Feature tracks of one sequence."""

    def __init__(self, camera: Camera, seed: int, features: int) -> None:
        self.camera = camera
        self.initialiser = Initialiser(0.5 * (camera.fx + camera.fy), seed)
        self._tracker = Tracker(camera, features, seed)
        self._shutter = RollingShutter(camera)
        self._count = 0

    def encode(self, frame: Frame) -> Encoded:
        """Track the frame; the descriptor is a thumbnail normalised in brightness and contrast."""
        grey = to_grey(frame.image)
        if grey.shape != (self.camera.height, self.camera.width):
            raise KfvoError(f'the calibration is for {self.camera.width}x{self.camera.height} '
                            f'images, {grey.shape[1]}x{grey.shape[0]} came')
        tracks = self._tracker.track(grey)
        points = self.camera.undistort(self._shutter.correct(frame.stamp_ns, tracks))
        usable = np.isfinite(points).all(axis=1)
        frame_tracks = FrameTracks(self._count, tracks.select(usable), points[usable])
        self._count += 1
        return Encoded(frame.stamp_ns, _thumbnail(grey), frame_tracks, tracks,
                       frame_tracks.blind)


class GeometricBackbone(Backbone):
    """Monocular backbone for calibrated cameras; tracks up to `features` corners per frame.

    Estimates have points, so scale is aligned by depth.
    """

    name = 'geometric'
    descriptor_size = THUMBNAIL[0] * THUMBNAIL[1]
    offers_tracks = True
    signal_names = SIGNAL_NAMES
    default_scale_rule = 'depth'
    unit = "the first scene's median depth"

    def __init__(self, seed: int = 0, features: int = FEATURES) -> None:
        self._seed, self._features = seed, features
        compile_entry_points()  # No frame waits for the compiler.

    def open(self, camera: Camera | None) -> GeometricStream:
        """Start a sequence; raises KfvoError without a calibration."""
        if camera is None:
            raise KfvoError('the geometric backbone needs a calibrated camera, none came; give '
                            'a camera_info.yaml')
        return GeometricStream(camera, self._seed, self._features)

    def estimate(self, windows: Sequence[Window]) -> list[Estimate]:
        """Solve each window."""
        return [_estimate(window, _stream_of(window)) for window in windows]


def _stream_of(window: Window) -> GeometricStream:
    if not isinstance(window.stream, GeometricStream):
        raise TypeError(f'expected a window of a GeometricStream, came {type(window.stream)}')
    return window.stream


def _estimate(window: Window, stream: GeometricStream) -> Estimate:
    """Return the estimate of one window, LOST where the newest frame shares < MIN_TRACKS."""
    frames: tuple[FrameTracks, ...] = tuple(encoded.payload for encoded in window.frames)
    prior = window.prior
    memory = history_of(prior)
    history = select_history(memory, 1.0 if prior is None else prior.memory_scale, frames[0])
    table = build_track_table(history.frames + frames, len(history.frames),
                              memory.intrinsics_filter)
    if table.mask[:, -1].sum() < MIN_TRACKS:
        return lost_estimate(window, len(SIGNAL_NAMES), KeyframeHistory())
    solution = solve(table, stream.initialiser, prior, history)
    poses = solution.T_anchor_frame
    if solution.problem.mask[-1].sum() < MIN_TRACKS or not np.isfinite(poses).all():
        return lost_estimate(window, len(SIGNAL_NAMES), KeyframeHistory())
    motion = measure_motion(solution, frames[-2], frames[-1], stream.initialiser.focal)
    intrinsics_filter = _update_intrinsics(memory, solution, frames, stream.camera)
    return Estimate(
        poses[solution.anchor:], solution.covariance, solution.points,
        compute_signals(solution, motion), Status.HELD if motion.held else Status.OK,
        _next_memory(memory, history.frames + frames, solution, intrinsics_filter),
        intrinsics_filter.intrinsics(stream.camera) if intrinsics_filter.converged else None)


def _next_memory(memory: KeyframeHistory, frames: tuple[FrameTracks, ...], solution: Solution,
                 intrinsics_filter: IntrinsicsFilter) -> KeyframeHistory:
    """Return the memory after a solved window; a point once measured well stays trusted."""
    ids = solution.points.ids
    trusted = solution.well_measured | tracker.ids_in(ids, memory.trusted_ids)
    return KeyframeHistory(
        frames, solution.T_anchor_frame, solution.median_depth,
        measured=memory.measured or solution.measured,
        last_unmeasured=memory.last_unmeasured if solution.measured else frames[-1].index,
        windows=memory.windows + 1, intrinsics_filter=intrinsics_filter,
        trusted_ids=ids[trusted])


def _update_intrinsics(memory: KeyframeHistory, solution: Solution,
                       frames: tuple[FrameTracks, ...], camera: Camera) -> IntrinsicsFilter:
    """Return the filter after this window, unchanged while too few of its frames are new.

    It is not used with a rolling shutter, whose residual effect it would absorb.
    """
    intrinsics_filter, indices = memory.intrinsics_filter, [frame.index for frame in frames]
    if not (memory.initialised and solution.measured and camera.readout_s == 0.0
            and intrinsics_filter.new_share(indices) >= MIN_NEW_SHARE):
        return intrinsics_filter
    return intrinsics_filter.update(solution.problem, solution.state, solution.noise, indices)


def _thumbnail(grey: np.ndarray) -> np.ndarray:
    """Return the descriptor (48,) float32 of zero mean and about unit deviation."""
    small = cv2.resize(grey, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    return (small - small.mean()) / (small.std() + 5.0)
