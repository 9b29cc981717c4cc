# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hand-held rotation and hovering: little parallax and much noise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pytest
from odometry_scenes import RATE_NS, certain_tracks

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Encoded
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.observations import FrameTracks
from kfvo_ros.camera import Camera
from kfvo_ros.evaluation import metrics
from kfvo_ros.keyframes.heuristics import EveryFrame
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.sequences.base import Frame
from kfvo_ros.tracking.tracker import Tracks
from kfvo_ros.trajectory import Trajectory

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
FRAMES, POINTS, TRACKS, NOISE = 240, 6000, 300, 0.3
NO_IMAGE = np.zeros((0, 0), dtype=np.uint8)
LOSS_SHARE = 0.03
"""Share of the tracks in the image that are lost at every frame."""


def random_wave(rng: np.random.Generator, size: float) -> np.ndarray:
    """Return a sum of slow sines (FRAMES, 3)."""
    phases, turns = rng.uniform(0.0, 2.0 * np.pi, (6, 3)), rng.uniform(0.15, 0.6, (6, 3))
    seconds = np.arange(FRAMES)[:, None, None] / 30.0
    return size * np.sin(2.0 * np.pi * turns * seconds + phases).sum(axis=1) / np.sqrt(3.0)


def random_points(rng: np.random.Generator) -> np.ndarray:
    """Return points (POINTS, 3) in all directions, at 1.2 to 4 m."""
    points = rng.normal(size=(POINTS, 3))
    return points * (rng.uniform(1.2, 4.0, (POINTS, 1))
                     / np.linalg.norm(points, axis=1, keepdims=True))


def project(rng: np.random.Generator, points: np.ndarray, T_world_camera: np.ndarray,
              noise: float = NOISE) -> Iterator[Tracks]:
    """Yield the tracks of visible points with `noise` [px] per axis."""
    ids, count = np.full(POINTS, -1), 0
    for T_camera_world in geometry.invert(T_world_camera):
        x, y, z = (points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]).T
        pixels = np.stack([x, y], axis=1) / np.maximum(z, 1e-6)[:, None] * CAMERA.fx
        pixels += (CAMERA.cx, CAMERA.cy)
        seen = (z > 0.1) & ((pixels > 4.0) & (pixels < (636.0, 476.0))).all(axis=1)
        ids[~seen | (rng.random(POINTS) < LOSS_SHARE)] = -1
        born = rng.permutation(np.flatnonzero(seen & (ids < 0)))[:TRACKS - (ids >= 0).sum()]
        ids[born] = np.arange(count, count + len(born))
        count += len(born)
        rows = np.flatnonzero(ids >= 0)
        rows = rows[np.argsort(ids[rows])]
        yield certain_tracks(ids[rows], pixels[rows] + noise * rng.normal(size=(len(rows), 2)))


def replay(tracks_per_frame: Iterable[Tracks]) -> Trajectory:
    """Return the trajectory of tracks when every frame is a keyframe."""
    backbone, final_poses = GeometricBackbone(), []
    odometry = KeyframeOdometry(backbone, EveryFrame())
    for index, tracks in enumerate(tracks_per_frame):
        encoded = Encoded(index * RATE_NS, np.zeros(48, dtype=np.float32),
                          FrameTracks(index, tracks, CAMERA.undistort(tracks.pixels)), tracks)
        window = odometry.encode(Frame(encoded.stamp_ns, NO_IMAGE, CAMERA), encoded)
        odometry.integrate(None if window is None else backbone.estimate([window])[0])
        final_poses += odometry.commit(True, {}).final
    final_poses += odometry.finish()
    return Trajectory(np.array([each.stamp_ns for each in final_poses]),
                      np.stack([each.T_world_camera for each in final_poses]))


def spread_of(positions: np.ndarray) -> float:
    return float(np.linalg.norm(positions - positions.mean(axis=0)))


def test_noise_does_not_act_as_parallax():
    """The camera rotates by tens of degrees and translates by centimetres, for 8 s.

    If the rays of the host frames were taken as exact, the scale would shrink, the error double.
    """
    drifts, errors = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = geometry.make_transform(geometry.exp_so3(random_wave(rng, 0.3)),
                                        random_wave(rng, 0.03))
        found = replay(project(rng, random_points(rng), truth))
        first, last = (spread_of(truth[part, :3, 3]) / spread_of(found.poses[part, :3, 3])
                       for part in (slice(0, 60), slice(-60, None)))
        drifts.append(np.log(last / first))
        errors.append(metrics.absolute_trajectory_error(
            found, Trajectory(found.stamps_ns, truth)).rmse)
    assert abs(np.mean(drifts)) < 0.1, drifts
    assert np.mean(errors) < 0.008, errors


def walk_turn_walk_poses() -> np.ndarray:
    """Return poses (120, 4, 4): 1 m forward, 50 degrees on the spot, 1 m forward."""
    pace = np.concatenate([np.full(40, 0.025), np.zeros(40), np.full(40, 0.025)])
    turn = np.concatenate([np.zeros(40), np.full(40, np.radians(1.25)), np.zeros(40)])
    rotations = geometry.exp_so3(np.cumsum(turn)[:, None] * [0.0, 1.0, 0.0])
    ahead = rotations[:, :, 2]
    return geometry.make_transform(rotations, np.cumsum(pace[:, None] * ahead, axis=0))


def test_new_points_after_a_turn_do_not_change_the_scale():
    """The new points are three times as far as the old ones.

    Half way through the turn most points are new; the earlier keyframes must still count.
    """
    drifts = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth, points = walk_turn_walk_poses(), random_points(rng)
        points[points[:, 0] > 0.3 * np.linalg.norm(points, axis=1)] *= 3.0
        found = replay(project(rng, points, truth))
        first, last = (spread_of(truth[part, :3, 3]) / spread_of(found.poses[part, :3, 3])
                       for part in (slice(0, 40), slice(-40, None)))
        drifts.append(np.log(last / first))
    assert np.abs(drifts).mean() < 0.04, drifts


def hover_along_a_wall(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return points (POINTS, 3) of a wall, and poses (120, 4, 4) along it.

    The camera rotates by 0.6 degrees per frame at standstill, between two translations.
    """
    pace = np.concatenate([np.full(40, 0.03), np.zeros(40), np.full(40, 0.03)])
    pace = np.convolve(np.pad(pace, 5, 'edge'), np.ones(11) / 11, 'valid')
    turn = np.concatenate([np.zeros(40), np.full(40, np.radians(0.6)), np.zeros(40)])
    return (rng.uniform((-6.0, -3.0, 2.0), (6.0, 3.0, 2.5), (POINTS, 3)),
            geometry.make_transform(geometry.exp_so3(np.cumsum(turn)[:, None] * [0.0, 1.0, 0.0]),
                                    np.cumsum(pace)[:, None] * [1.0, 0.0, 0.0]))


def with_random_walk(rng: np.random.Generator, tracks_per_frame: Iterable[Tracks]
                     ) -> Iterator[Tracks]:
    """Yield tracks that drift from their points by a random walk of 0.05 px per axis and frame."""
    offsets = np.zeros((0, 2))
    for tracks in tracks_per_frame:
        offsets = np.concatenate([offsets, np.zeros((tracks.ids.max() + 1 - len(offsets), 2))])
        offsets += 0.05 * rng.normal(size=offsets.shape)
        yield certain_tracks(tracks.ids, tracks.pixels + offsets[tracks.ids])


@pytest.mark.parametrize('seed', range(3))
def test_hovering_along_a_wall_keeps_the_scale(seed):
    """Two motions explain the first frames after it; the window has no depths to decide."""
    rng = np.random.default_rng(seed)
    points, truth = hover_along_a_wall(rng)
    found = replay(with_random_walk(rng, project(rng, points, truth, noise=0.15)))
    first, last = (spread_of(truth[part, :3, 3]) / spread_of(found.poses[part, :3, 3])
                   for part in (slice(0, 35), slice(-30, None)))
    assert abs(np.log(last / first)) < 0.05
