# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes for tests of odometry: projected point clouds and small rendered sequences."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Backbone, Encoded, Window
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.observations import FrameTracks
from kfvo_ros.camera import Camera
from kfvo_ros.keyframes.base import DecisionInput, KeyframePolicy
from kfvo_ros.keyframes.heuristics import Survival
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.odometry.updates import FramePose, Update
from kfvo_ros.sequences.base import Frame
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.tracking.tracker import Tracks
from kfvo_ros.trajectory import Trajectory

CAMERA = Camera(640, 480, 400.0, 400.0, 319.5, 239.5)
RATE_NS = 50_000_000
PATTERN = [True, False, False, True, False]
"""Decisions of a ScriptedPolicy, to be repeated."""


def certain_tracks(ids: np.ndarray, pixels: np.ndarray) -> Tracks:
    """Return tracks without uncertainty."""
    return Tracks(ids, pixels, np.zeros(len(ids)))


class PointCloud:
    """Random points in front of the first camera, observed with `noise` [px]."""

    def __init__(self, seed: int, count: int = 300, noise: float = 0.0) -> None:
        self._rng = np.random.default_rng(seed)
        depths = self._rng.uniform(3.0, 8.0, count)
        self.points = np.column_stack([self._rng.uniform(-0.7, 0.7, (count, 2)), np.ones(count)])
        self.points *= depths[:, None]
        self.noise = noise

    def pixels(self, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (N, 2) of all points, and a mask of the visible ones."""
        T_camera_world = geometry.invert(T_world_camera)
        points = self.points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        pixels = points[:, :2] / points[:, 2:] * CAMERA.fx + (CAMERA.cx, CAMERA.cy)
        inside = (pixels > 0.0).all(axis=1) & (pixels < (CAMERA.width, CAMERA.height)).all(axis=1)
        return pixels, inside & (points[:, 2] > 0.1)

    def encode(self, index: int, T_world_camera: np.ndarray) -> Encoded:
        """Return a frame as encoded by the geometric backbone: exact tracks plus noise."""
        pixels, visible = self.pixels(T_world_camera)
        pixels = pixels + self.noise * self._rng.normal(size=pixels.shape)
        tracks = certain_tracks(np.flatnonzero(visible), pixels[visible])
        frame_tracks = FrameTracks(index, tracks, CAMERA.undistort(tracks.pixels))
        descriptor = np.full(48, index, dtype=np.float32)
        return Encoded(index * RATE_NS, descriptor, frame_tracks, tracks)


def window(poses: np.ndarray, seed: int = 0, noise: float = 0.0,
           backbone: GeometricBackbone | None = None) -> Window:
    """Return the first window of a new stream."""
    cloud = PointCloud(seed, noise=noise)
    frames = tuple(cloud.encode(index, pose) for index, pose in enumerate(poses))
    return Window((backbone or GeometricBackbone()).open(CAMERA), frames)


def moving_poses(count: int, step: float = 0.15) -> np.ndarray:
    """Return poses (N, 4, 4) of a camera that moves right and forward and turns slightly."""
    along = np.arange(count)[:, None]
    return geometry.make_transform(
        geometry.exp_so3(along * [0.004, 0.012, -0.006]),
        along * step * np.array([0.8, 0.1, 0.6]) + 0.05 * np.sin(0.9 * along + [0.0, 1.0, 2.0]))


def turning_poses(count: int) -> np.ndarray:
    """Return poses (N, 4, 4) of a camera that turns on the spot."""
    return geometry.make_transform(
        geometry.exp_so3(np.arange(count)[:, None] * [0.004, 0.02, -0.006]), np.zeros(3))


@lru_cache(maxsize=8)
def frames_of(seed: int, count: int = 60, style: str = 'smooth', width: int = 320,
              height: int = 240) -> tuple[Frame, ...]:
    """Return rendered frames, the same objects at every call."""
    return tuple(SyntheticSequence(seed, style, count, width, height))


def truth_of(seed: int, count: int = 60, style: str = 'smooth') -> Trajectory:
    """Return the ground truth of `frames_of`."""
    return SyntheticSequence(seed, style, count).ground_truth().trajectory


def restamped(images: Iterable[np.ndarray], camera: Camera) -> list[Frame]:
    """Return frames of the images with regular stamps."""
    return [Frame(RATE_NS * (1 + index), image, camera) for index, image in enumerate(images)]


@dataclass
class OdometryRun:
    """Output of an odometry: updates, final poses, and copies of these when they became final."""

    updates: list[Update]
    final: list[FramePose]
    emitted_poses: list[np.ndarray]

    @property
    def poses(self) -> np.ndarray:
        """Final poses (N, 4, 4) in input order."""
        return np.stack([frame.T_world_camera for frame in self.final])

    @property
    def trajectory(self) -> Trajectory:
        """Final poses with their stamps."""
        return Trajectory(np.array([frame.stamp_ns for frame in self.final]), self.poses)

    @property
    def statuses(self) -> list[str]:
        """Status of each frame."""
        return [update.status.value for update in self.updates]


def run(frames: Iterable[Frame], policy: KeyframePolicy | None = None,
        backbone: Backbone | None = None, **options) -> OdometryRun:
    """Process frames with a new odometry."""
    odometry = KeyframeOdometry(backbone or GeometricBackbone(), policy or Survival(), **options)
    result = OdometryRun([], [], [])
    for frame in frames:
        update = odometry.process(frame)
        result.updates.append(update)
        result.final.extend(update.final)
        result.emitted_poses.extend(pose.T_world_camera.copy() for pose in update.final)
    last = odometry.finish()
    result.final.extend(last)
    result.emitted_poses.extend(pose.T_world_camera.copy() for pose in last)
    return result


class ScriptedPolicy(KeyframePolicy):
    """Returns given decisions in order; repeats the last one."""

    name = 'scripted'

    def __init__(self, *keeps: bool) -> None:
        self._keeps = list(keeps)
        self.inputs: list[DecisionInput] = []

    def decide(self, decision: DecisionInput) -> bool:
        """Return the next decision."""
        self.inputs.append(decision)
        return self._keeps.pop(0) if len(self._keeps) > 1 else self._keeps[0]


def with_image(frame: Frame, image: np.ndarray) -> Frame:
    """Return the frame with another image."""
    return replace(frame, image=image)
