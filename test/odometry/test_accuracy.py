# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far the odometry is from the truth, with bounds that it must keep."""

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


class Recorded(GeometricBackbone):
    """The geometric backbone with a sequence's frames encoded once for all policies."""

    def __init__(self, encoded: list[Encoded]) -> None:
        super().__init__()
        self._encoded = {one.stamp_ns: one for one in encoded}

    def open(self, camera: Camera | None) -> GeometricStream:
        stream = super().open(camera)
        stream.encode = lambda frame: self._encoded[frame.stamp_ns]
        return stream


@lru_cache(maxsize=1)
def recorded(text: str, count: int) -> tuple[Sequence, Recorded]:
    sequence = open_sequence(text)
    stream = GeometricBackbone().open(sequence.camera)
    return sequence, Recorded([stream.encode(frame) for frame in islice(sequence, count)])


def stamped(backbone: Recorded, camera: Camera | None) -> Iterator[Frame]:
    return (Frame(stamp_ns, np.zeros((1, 1), np.uint8), camera)
            for stamp_ns in backbone._encoded)


def error_percent(text: str, count: int, policy: str) -> float:
    """Return the ATE in percent of the path, and assert that it beats the trivial answers."""
    sequence, backbone = recorded(text, count)
    truth = sequence.ground_truth().trajectory
    result = run(stamped(backbone, sequence.camera), POLICIES[policy](), backbone)
    assert 'lost' not in result.statuses
    estimate = result.trajectory
    error = metrics.absolute_trajectory_error(estimate, truth)
    for trivial in (metrics.constant_position, metrics.straight_line):
        assert error.rmse < metrics.absolute_trajectory_error(
            trivial(estimate.stamps_ns), truth).rmse
    return 100.0 * error.rmse / error.path_length


@pytest.mark.parametrize(('policy', 'bound'), [('every', 0.9), ('survival', 0.4),
                                               ('optical_flow', 0.5)])
def test_newtsukuba(policy, bound, data_path):
    assert error_percent(str(data_path('newtsukuba')), 200, policy) <= bound


@pytest.mark.parametrize('policy', ['every', 'survival'])
def test_tartanair(policy, data_path):
    assert error_percent(str(data_path('tartanair/sample/Easy/P000')), 200, policy) <= 2.0


@pytest.mark.parametrize('policy', ['every', 'survival', 'optical_flow'])
def test_standing_still(policy, data_path):
    sequence, backbone = recorded(str(data_path('euroc/V1_01_easy_static')), 200)
    result = run(stamped(backbone, sequence.camera), POLICIES[policy](), backbone)
    depth = np.median([update.median_depth for update in result.updates[1:]])
    trajectory: Trajectory = result.trajectory
    assert metrics.extent(trajectory) / depth <= 0.01
    assert metrics.max_rotation_deg(trajectory) <= 1.0


@pytest.mark.parametrize(('policy', 'bound'), [('every', 0.8), ('survival', 0.6)])
@pytest.mark.parametrize('name', ['synthetic:0:smooth', 'synthetic:1:fast', 'synthetic:3:street'])
def test_rendered(name, policy, bound):
    assert error_percent(name, 80, policy) <= bound
