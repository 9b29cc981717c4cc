# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories for the tests of metrics: by hand, random, perturbed, and real ones."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.geometry import Similarity
from kfvo_ros.trajectory import Trajectory, parse_stamp_ns, read_kitti_poses, read_tum

EPOCH_NS = 1_403_715_273_262_142_976
MILLISECOND = 1_000_000


def trajectory(positions, step_ms: int = 100, rotation_vectors=None) -> Trajectory:
    """Return poses at regular stamps, without rotation by default."""
    positions = np.asarray(positions, dtype=np.float64)
    if rotation_vectors is None:
        rotation_vectors = np.zeros_like(positions)
    stamps_ns = EPOCH_NS + np.arange(len(positions)) * step_ms * MILLISECOND
    rotations = geometry.exp_so3(rotation_vectors)
    return Trajectory(stamps_ns, geometry.make_transform(rotations, positions))


def along_x(*x: float) -> Trajectory:
    """Return positions on a line."""
    return trajectory([[value, 0.0, 0.0] for value in x])


def random_walk(seed: int, count: int = 150) -> Trajectory:
    """Return a random walk in position and rotation with two pauses."""
    rng = np.random.default_rng(seed)
    steps = geometry.make_transform(geometry.exp_so3(rng.normal(0, 0.1, (count, 3))),
                                    rng.normal(0.2, 0.3, (count, 3)))
    steps[30:40] = steps[100:103] = np.eye(4)
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ step)
    return Trajectory(EPOCH_NS + np.cumsum(rng.integers(30, 70, count)) * MILLISECOND,
                      np.array(poses))


def perturbed(truth: Trajectory, seed: int, trans: float = 0.05, rot: float = 0.02) -> Trajectory:
    """Return the truth with drift and noise, in another world frame and scale."""
    rng = np.random.default_rng(seed)
    count = len(truth)
    drift = np.cumsum(rng.normal(0, trans, (count, 3)), axis=0) / 3
    noise = geometry.make_transform(geometry.exp_so3(rng.normal(0, rot, (count, 3))),
                                    rng.normal(0, trans, (count, 3)) + drift)
    world = Similarity(0.3, geometry.exp_so3([0.5, -1.0, 2.0]), np.array([7.0, 8.0, 9.0]))
    return Trajectory(truth.stamps_ns, world.transform_poses(truth.poses @ noise))


def stamps_of(path: Path) -> np.ndarray:
    """Return the stamps (N,) [ns] in the first column of a file."""
    lines = path.read_text().splitlines()
    return np.array([parse_stamp_ns(line.split()[0]) for line in lines
                     if not line.startswith('#')])


def freiburg1_rpy(data_path: Callable[[str], Path]) -> tuple[np.ndarray, Trajectory]:
    """Return the frames' stamps and the ground truth, or skip the test."""
    folder = data_path('tum/rgbd_dataset_freiburg1_rpy')
    return stamps_of(folder / 'rgb.txt'), read_tum(folder / 'groundtruth.txt')


def evo_data(name: str) -> Path:
    """Return one of the published trajectories in evo's own tests, or skip the test."""
    evo = pytest.importorskip('evo', reason='evo is not installed')
    folder = Path(os.environ.get('EVO_DATA') or Path(evo.__file__).parents[1] / 'test' / 'data')
    if not (folder / name).exists():
        pytest.skip("evo's trajectories are not in its wheel: set EVO_DATA to the folder "
                    'test/data of its source (pip download --no-deps --no-binary :all: evo)')
    return folder / name


def evo_kitti(name: str) -> Trajectory:
    """Return KITTI 00, its ground truth (``gt``) or an estimate, or skip the test."""
    return read_kitti_poses(evo_data(f'KITTI_00_{name}.txt'),
                            stamps_of(evo_data('KITTI_00_gt_times.txt')))
