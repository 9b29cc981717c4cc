# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth against the images of real data.

A wrong convention, axis order, direction or lens model shows as an epipolar error.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.images import to_grey
from kfvo_ros.sequences import open_sequence
from kfvo_ros.trajectory import associate

AXES = geometry.make_transform(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                               np.zeros(3))


def matches(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) of corners in both images, by KLT there and back."""
    options = {'winSize': (21, 21), 'maxLevel': 4}
    start = cv2.goodFeaturesToTrack(first, 400, 0.005, 10)
    end, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, end, None, **options)
    good = (found & returned).ravel().astype(bool)
    good &= np.linalg.norm((start - back).reshape(-1, 2), axis=1) < 0.5
    return start.reshape(-1, 2)[good], end.reshape(-1, 2)[good]


def epipolar_error(camera: Camera, first: np.ndarray, second: np.ndarray, T_second_first) -> float:
    """Return the median Sampson distance [px] of matches under a relative pose."""
    E = geometry.skew(T_second_first[:3, 3]) @ T_second_first[:3, :3]
    rays = [np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
            for pixels in (first, second)]
    lines_second, lines_first = rays[0] @ E.T, rays[1] @ E
    distance = np.sum(rays[1] * lines_second, axis=1) / np.sqrt(
        np.sum(lines_second[:, :2] ** 2, axis=1) + np.sum(lines_first[:, :2] ** 2, axis=1))
    return float(np.nanmedian(np.abs(distance))) * camera.fx


@pytest.mark.parametrize(('path', 'gap', 'limit', 'ratio'), [
    ('tartanair/sample/Easy/P000', 1, 0.3, 10),
    ('kitti/sequences/03', 2, 0.5, 10),
    ('newtsukuba', 2, 0.3, 10),
    ('tum/rgbd_dataset_freiburg1_rpy', 6, 1.5, 10),  # motion capture beside a rolling shutter
    ('euroc/V1_01_easy_static', 10, 0.3, 2),  # hardly moves: little to tell wrong from right
])
def test_poses_agree_with_images(path, gap, limit, ratio, data_path):
    sequence = open_sequence(str(data_path(path)))
    frames = list(itertools.islice(sequence, 120))
    truth = sequence.ground_truth().trajectory
    indices, of_truth = associate(np.array([frame.stamp_ns for frame in frames]), truth.stamps_ns)
    poses = dict(zip(indices.tolist(), truth.poses[of_truth]))
    right, wrong = [], []
    for index in range(0, len(frames) - gap, max(1, len(frames) // 10)):
        if index in poses and index + gap in poses:
            first, second = matches(to_grey(frames[index].image),
                                    to_grey(frames[index + gap].image))
            relative = geometry.relative(poses[index + gap], poses[index])
            other_axes = geometry.relative(AXES, relative @ AXES)
            right.append(epipolar_error(sequence.camera, first, second, relative))
            wrong.append(epipolar_error(sequence.camera, first, second, other_axes))
    assert len(right) >= 5
    assert np.median(right) < limit
    assert np.median(wrong) > ratio * np.median(right)
