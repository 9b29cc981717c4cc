# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth of real datasets against their images.

A wrong convention, axis order, direction or distortion model shows as an epipolar error.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from epipolar import epipolar_errors

from kfvo_ros import geometry
from kfvo_ros.images import to_grey
from kfvo_ros.sequences import open_sequence
from kfvo_ros.trajectory import associate

AXES = geometry.make_transform(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                               np.zeros(3))


def matches(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) of corners in both images, by KLT with a forward-backward check."""
    options = {'winSize': (21, 21), 'maxLevel': 4}
    start = cv2.goodFeaturesToTrack(first, 400, 0.005, 10)
    end, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, end, None, **options)
    good = (found & returned).ravel().astype(bool)
    good &= np.linalg.norm((start - back).reshape(-1, 2), axis=1) < 0.5
    return start.reshape(-1, 2)[good], end.reshape(-1, 2)[good]


@pytest.mark.parametrize(('path', 'gap', 'limit', 'ratio'), [
    ('tartanair/sample/Easy/P000', 1, 0.3, 10),
    ('kitti/sequences/03', 2, 0.5, 10),
    ('newtsukuba', 2, 0.3, 10),
    ('tum/rgbd_dataset_freiburg1_rpy', 6, 1.5, 10),  # rolling shutter
    ('euroc/V1_01_easy_static', 10, 0.3, 2),  # nearly static: a weak constraint
])
def test_poses_satisfy_the_epipolar_constraint(path, gap, limit, ratio, data_path):
    sequence = open_sequence(str(data_path(path)))
    frames = list(itertools.islice(sequence, 120))
    truth = sequence.ground_truth().trajectory
    indices, truth_indices = associate(np.array([frame.stamp_ns for frame in frames]),
                                       truth.stamps_ns)
    poses = dict(zip(indices.tolist(), truth.poses[truth_indices]))
    right, wrong = [], []
    for index in range(0, len(frames) - gap, max(1, len(frames) // 10)):
        if index in poses and index + gap in poses:
            first, second = matches(to_grey(frames[index].image),
                                    to_grey(frames[index + gap].image))
            relative = geometry.relative(poses[index + gap], poses[index])
            other_axes = geometry.relative(AXES, relative @ AXES)
            right.append(np.nanmedian(
                epipolar_errors(sequence.camera, first, second, relative)))
            wrong.append(np.nanmedian(
                epipolar_errors(sequence.camera, first, second, other_axes)))
    assert len(right) >= 5
    assert np.median(right) < limit
    assert np.median(wrong) > ratio * np.median(right)
