# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Accuracy of the odometry: upper bounds of its errors."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import islice

import numpy as np
import pytest
from odometry_scenes import run

from kfvo_ros.backbones.base import Encoded
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone, GeometricStream
from kfvo_ros.camera import Camera
from kfvo_ros.evaluation import metrics
from kfvo_ros.keyframes.heuristics import EveryFrame, OpticalFlow, Survival
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.base import Frame, Sequence
from kfvo_ros.trajectory import Trajectory

POLICIES = {'every': EveryFrame, 'survival': Survival, 'optical_flow': OpticalFlow}


class RecordedBackbone(GeometricBackbone):
    """The geometric backbone with the frames of a sequence encoded once for all policies."""

    def __init__(self, encoded: list[Encoded]) -> None:
        super().__init__()
        self._encoded = {each.stamp_ns: each for each in encoded}

    def open(self, camera: Camera | None) -> GeometricStream:
        stream = super().open(camera)
        stream.encode = lambda frame: self._encoded[frame.stamp_ns]
        return stream


@lru_cache(maxsize=1)
def recorded_backbone(text: str, count: int) -> tuple[Sequence, RecordedBackbone]:
    sequence = open_sequence(text)
    stream = GeometricBackbone().open(sequence.camera)
    return sequence, RecordedBackbone([stream.encode(frame) for frame in islice(sequence, count)])


def stamped(backbone: RecordedBackbone, camera: Camera | None) -> Iterator[Frame]:
    return (Frame(stamp_ns, np.zeros((1, 1), np.uint8), camera)
            for stamp_ns in backbone._encoded)


def error_percent(text: str, count: int, policy: str) -> float:
    """Return the ATE in percent of the path, and assert that it beats the trivial baselines."""
    sequence, backbone = recorded_backbone(text, count)
    truth = sequence.ground_truth().trajectory
    result = run(stamped(backbone, sequence.camera), POLICIES[policy](), backbone)
    assert 'lost' not in result.statuses
    estimate = result.trajectory
    error = metrics.absolute_trajectory_error(estimate, truth)
    for baseline in (metrics.constant_position, metrics.straight_line):
        assert error.rmse < metrics.absolute_trajectory_error(
            baseline(estimate.stamps_ns), truth).rmse
    return 100.0 * error.rmse / error.path_length


@pytest.mark.parametrize(('policy', 'bound'), [('every', 0.9), ('survival', 0.4),
                                               ('optical_flow', 0.5)])
def test_newtsukuba(policy, bound, data_path):
    assert error_percent(str(data_path('newtsukuba')), 200, policy) <= bound


@pytest.mark.parametrize('policy', ['every', 'survival'])
def test_tartanair(policy, data_path):
    assert error_percent(str(data_path('tartanair/sample/Easy/P000')), 200, policy) <= 2.0


@pytest.mark.parametrize('policy', ['every', 'survival', 'optical_flow'])
def test_standstill(policy, data_path):
    sequence, backbone = recorded_backbone(str(data_path('euroc/V1_01_easy_static')), 200)
    result = run(stamped(backbone, sequence.camera), POLICIES[policy](), backbone)
    depth = np.median([update.median_depth for update in result.updates[1:]])
    trajectory: Trajectory = result.trajectory
    assert metrics.extent(trajectory) / depth <= 0.01
    assert metrics.max_rotation_deg(trajectory) <= 1.0


@pytest.mark.parametrize(('policy', 'bound'), [('every', 0.8), ('survival', 0.6)])
@pytest.mark.parametrize('name', ['synthetic:0:smooth', 'synthetic:1:fast', 'synthetic:3:street'])
def test_rendered(name, policy, bound):
    assert error_percent(name, 80, policy) <= bound
