# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The geometric backbone against the contract: encode by tracking, estimate by solving."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from kfvo_ros.backbones.base import Backbone, Encoded, Estimate, Status, Stream, Window, lost
from kfvo_ros.backbones.geometric import bundle_adjustment as ba
from kfvo_ros.backbones.geometric import reprojection, schur
from kfvo_ros.backbones.geometric.initialisation import Initialiser
from kfvo_ros.backbones.geometric.keyframe_history import (
    KeyframeHistory,
    count_shared,
    history_of,
    recall,
)
from kfvo_ros.backbones.geometric.numba_utils import (
    median,
    median_where,
    medians_of_nearest,
)
from kfvo_ros.backbones.geometric.observations import FrameTracks, build_track_table, merge_tracks
from kfvo_ros.backbones.geometric.reprojection import Problem, State
from kfvo_ros.backbones.geometric.rolling_shutter import RollingShutter
from kfvo_ros.backbones.geometric.self_calibration import (
    ASKED_AGAIN,
    IntrinsicsFilter,
    undistort_points,
)
from kfvo_ros.backbones.geometric.signals import (
    SIGNAL_NAMES,
    correlate,
    measure_motion,
    median_shifts,
    signals,
)
from kfvo_ros.backbones.geometric.triangulation import point_positions, triangulate
from kfvo_ros.backbones.geometric.window import Solution, solve
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.images import to_grey
from kfvo_ros.sequences.base import Frame
from kfvo_ros.tracking import tracker
from kfvo_ros.tracking.tracker import FEATURES, Tracker

THUMBNAIL = (8, 6)
MIN_TRACKS = 12
"""The newest frame needs as many tracks in common with the window to be placed."""


class GeometricStream(Stream):
    """Tracks of one sequence."""

    def __init__(self, camera: Camera, seed: int, features: int) -> None:
        self.camera = camera
        self.initialiser = Initialiser(0.5 * (camera.fx + camera.fy), seed)
        self._tracker = Tracker(camera, features, seed)
        self._shutter = RollingShutter(camera)
        self._count = 0

    def encode(self, frame: Frame) -> Encoded:
        """Track the frame; the descriptor is an 8x6 thumbnail free of brightness and contrast."""
        grey = to_grey(frame.image)
        if grey.shape != (self.camera.height, self.camera.width):
            raise KfvoError(f'the calibration is for {self.camera.width}x{self.camera.height} '
                            f'images, {grey.shape[1]}x{grey.shape[0]} came')
        tracks = self._tracker.track(grey)
        points = self.camera.undistort(self._shutter.correct(frame.stamp_ns, tracks))
        usable = np.isfinite(points).all(axis=1)
        view = FrameTracks(self._count, tracks.select(usable), points[usable])
        self._count += 1
        return Encoded(frame.stamp_ns, _describe(grey), view, tracks)


class GeometricBackbone(Backbone):
    """Needs a calibrated camera; poses come with points, so scale is aligned by depth.

    It follows up to so many `features` per frame.
    """

    name = 'geometric'
    descriptor_size = THUMBNAIL[0] * THUMBNAIL[1]
    offers_tracks = True
    signal_names = SIGNAL_NAMES
    default_scale_rule = 'depth'
    unit = "the first scene's median depth"

    def __init__(self, seed: int = 0, features: int = FEATURES) -> None:
        self._seed, self._features = seed, features
        compile_kernels()

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
    views = tuple(encoded.payload for encoded in window.frames)
    previous = window.previous
    memory = history_of(previous)
    history = recall(memory, 1.0 if previous is None else previous.memory_scale, views[0])
    observations = build_track_table(history.views + views, len(history.views), memory.lens)
    if observations.mask[:, -1].sum() < MIN_TRACKS:
        return lost(window, len(SIGNAL_NAMES), KeyframeHistory())
    solution = solve(observations, stream.initialiser, previous, history)
    poses = solution.T_anchor_frame
    if solution.problem.mask[-1].sum() < MIN_TRACKS or not np.isfinite(poses).all():
        return lost(window, len(SIGNAL_NAMES), KeyframeHistory())
    motion = measure_motion(solution, views[-2], views[-1], stream.initialiser.focal)
    lens = _update_intrinsics(memory, solution, views, stream.camera)
    return Estimate(poses[solution.anchor:], solution.covariance, solution.points,
                    signals(solution, motion),
                    Status.HELD if motion.held else Status.OK,
                    KeyframeHistory(history.views + views, poses, solution.median_depth,
                                    measured=memory.measured or solution.measured,
                                    unmeasured=memory.unmeasured if solution.measured else views[-1].index,
                                    windows=memory.windows + 1, lens=lens,
                                    trusted=_trusted_points(memory, solution)),
                    lens.intrinsics(stream.camera) if lens.known else None)


def _trusted_points(memory: KeyframeHistory, solution: Solution) -> np.ndarray:
    """Return the ids of those points whose depths are measured well, or once were."""
    ids = solution.points.ids
    return ids[solution.well_known | tracker.present(ids, memory.trusted)]


def _update_intrinsics(memory: KeyframeHistory, solution: Solution, views: tuple[FrameTracks, ...], camera: Camera) -> IntrinsicsFilter:
    """Ask the window of the lens, once enough of its frames are new.

    What a rolling shutter leaves in the tracks would be laid to the lens.
    """
    lens, indices = memory.lens, [view.index for view in views]
    if not (memory.certain and solution.measured and camera.readout_s == 0.0
            and lens.new_in(indices) >= ASKED_AGAIN):
        return lens
    return lens.told(solution.problem, solution.state, solution.noise, indices)


def _describe(grey: np.ndarray) -> np.ndarray:
    small = cv2.resize(grey, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    return (small - small.mean()) / (small.std() + 5.0)


def compile_kernels() -> None:
    """Compile everything, or load it from the cache, before a frame would wait for it."""
    rotations, translations, ones = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.ones(1)
    points = undistort_points(np.zeros((2, 2)), np.zeros(ba.LENS))
    ids, seen, mask, hosts, _ = merge_tracks(np.zeros(2, dtype=np.int64), points, np.zeros(2),
                                             np.array([1, 2]), 1)
    rays = np.ones((1, 3))
    triangulate(rotations, translations, hosts, rays, seen, mask)
    point_positions(rotations, translations, hosts, rays, ones)
    median_shifts(seen, mask, 0, correlate(seen, mask, 0))
    medians_of_nearest(seen[:, 0].copy(), seen[:, 1].copy(), ones, 1)
    median(ones)
    median_where(np.ones((1, 1)), mask[:, :1])
    count_shared(ids, ids)
    problem = Problem(hosts, np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, 2, 1)),
                      np.ones((2, 1), dtype=np.bool_), 1.0, 1, ones, ones, ones, 1.0)
    state = ba.adjust(problem, State(rotations, translations, np.ones((3, 1))), 1)
    reprojection.errors(problem, state)
    reprojection.cost(problem, state)
    schur.reduce(ba.linearise(problem, state, True, np.float64))
    schur.depth_information(ba.linearise(problem, state, False, np.float64))
