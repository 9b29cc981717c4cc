# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images that show nothing are LOST, start nothing, and do not harm the images after them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from blind_images import KINDS, blind_image
from odometry_scenes import OdometryRun, frames_of, run, truth_of, with_image

from kfvo_ros.backbones.base import LOST_VARIANCE, Backbone, Encoded, Estimate, Stream, Window
from kfvo_ros.evaluation.metrics import absolute_trajectory_error
from kfvo_ros.keyframes.heuristics import EveryFrame
from kfvo_ros.odometry.keyframe_odometry import MAX_LOST_FRAMES
from kfvo_ros.sequences.base import Frame
from kfvo_ros.trajectory import Trajectory

COUNT = 34


@pytest.fixture(scope='module')
def frames() -> tuple[Frame, ...]:
    return frames_of(0, COUNT)


def path_error(result: OdometryRun, indices: list[int]) -> float:
    """Return the ATE over some frames as a share of their path."""
    truth = truth_of(0, COUNT).select(indices)
    error = absolute_trajectory_error(Trajectory(truth.stamps_ns, result.poses[indices]), truth)
    return error.rmse / error.path_length


def with_blind_images(frames, indices: Sequence[int], kind: str) -> list[Frame]:
    """Return the frames with other images of one of KINDS at `indices`."""
    rng = np.random.default_rng(0)
    return [with_image(frame, blind_image(kind, frame.image.shape, rng)) if index in indices
            else frame for index, frame in enumerate(frames)]


@pytest.mark.parametrize('kind', KINDS)
def test_blind_images_are_lost_and_no_keyframes(frames, kind):
    """One image, and more than tracking and window survive."""
    alone, gap = [8], [*range(16, 26)]
    result = run(with_blind_images(frames, alone + gap, kind), EveryFrame())
    lost = [index for index, status in enumerate(result.statuses) if status == 'lost']
    assert lost == [*alone, *gap, 26]  # the first image after the gap starts a window
    keyframes = [index for index, update in enumerate(result.updates) if update.is_keyframe]
    assert keyframes == [index for index in range(COUNT) if index not in alone + gap]
    assert path_error(result, [*range(8), *range(9, 16)]) < 0.03


@pytest.mark.parametrize('kind', ['black, noise 0', 'black, noise 3', 'uniform noise'])
def test_the_first_image_that_shows_something_is_the_origin(frames, kind):
    result = run(with_blind_images(frames[:30], range(10), kind))
    plain = run(frames[10:30])
    assert result.statuses == ['lost'] * 10 + plain.statuses
    assert np.array_equal(result.poses[10:], plain.poses)
    assert np.array_equal(result.poses[:10], np.tile(np.eye(4), (10, 1, 1)))
    for index, update in enumerate(result.updates):
        expected = (LOST_VARIANCE * np.eye(6) if index < 10
                    else plain.updates[index - 10].covariance)
        assert np.array_equal(update.covariance, expected)


class CountingBackbone(Backbone):
    """Places each frame 1 unit after the one before; frames without a camera are blind."""

    name, descriptor_size, needs_camera = 'counting', 1, False

    def __init__(self) -> None:
        self.windows: list[int] = []
        self.released: list[int] = []

    def open(self, camera: object) -> Stream:
        """Return a stream that records what is released."""
        released = self.released

        class CountingStream(Stream):
            def encode(self, frame: Frame) -> Encoded:
                return Encoded(frame.stamp_ns, np.ones(1, np.float32), blind=frame.stamp_ns < 0)

            def release(self, encoded: Encoded) -> None:
                released.append(encoded.stamp_ns)
        return CountingStream()

    def estimate(self, windows: Sequence[Window]) -> list[Estimate]:
        """Return poses along x."""
        window, = windows
        self.windows.append(window.frames[-1].stamp_ns)
        poses = np.tile(np.eye(4), (len(window.frames), 1, 1))
        poses[:, 0, 3] = np.arange(len(poses))
        return [Estimate(poses, lambda: np.tile(np.eye(6), (len(poses), 1, 1)), None,
                         np.zeros(0, np.float32))]


def test_any_backbone_may_call_a_frame_blind():
    """A backbone never sees blind frames, and frees them at once."""
    image = np.zeros((4, 4), np.uint8)
    stamps = [-1, -2, 3, 4, -5, 6, *range(-16, -16 + 2 * MAX_LOST_FRAMES), 20, 21]
    backbone = CountingBackbone()
    result = run([Frame(stamp, image, None) for stamp in stamps], EveryFrame(), backbone)
    assert [pose.stamp_ns for pose in result.final] == stamps
    expected = ['lost' if stamp < 0 or stamp == 20 else 'ok' for stamp in stamps]
    assert result.statuses == expected
    assert backbone.windows == [4, 6, 21]
    assert [stamp for stamp in backbone.released if stamp < 0] == [
        stamp for stamp in stamps if stamp < 0]
    np.testing.assert_allclose(result.poses[:, 0, 3], [0, 0, 0, 1, 1, 2, *[2] * 11, 3])
