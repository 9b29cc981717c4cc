# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reuse in a sliding window: equal poses, less work, and the memory of one window."""

from __future__ import annotations

import copy
import gc
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace

import numpy as np
import pytest
from odometry_scenes import ScriptedPolicy
from vggt_models import (
    WIDTH,
    Tensor,
    make_window,
    noise_frames,
    record_calls,
    small_model,
    to_tensor,
    torch,
    with_precision,
)

from kfvo_ros.backbones.base import Window
from kfvo_ros.backbones.vggt.backbone import VggtBackbone
from kfvo_ros.backbones.vggt.config import NUM_PREFIX_TOKENS
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.backbones.vggt.preprocessing import fit_image
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.sequences.base import Frame

DECISIONS, WINDOW = 30, 8
COUNT = WINDOW - 1 + DECISIONS
KEEPS = np.random.default_rng(4).random(DECISIONS) < 0.5
FRAMES = noise_frames(COUNT)
IMAGE_BYTES, TOKENS_BYTES = 4 * 3 * 56 * 70, 4 * (NUM_PREFIX_TOKENS + 4 * 5) * 128
"""Sizes of one frame's image and of its tokens in one layer, both float32 [bytes]."""


def iterate_windows(backbone: VggtBackbone, frames: Sequence[Frame], keeps: Sequence[bool]
           ) -> Iterator[Window | None]:
    """Run an odometry as `process` does; yield its window before each estimate."""
    odometry = KeyframeOdometry(backbone, ScriptedPolicy(*keeps), window_size=WINDOW)
    for frame in frames:
        window = odometry.encode(frame)
        yield window
        step = odometry.integrate(backbone.estimate([window])[0] if window else None)
        odometry.commit(step.keep if step.decision is None
                        else odometry.policy.decide(step.decision), {})


def recompute(model: Vggt, window: Window, frames: Sequence[Frame]) -> np.ndarray:
    """Return the pose encodings of the published model, computed from the images."""
    by_stamp = {frame.stamp_ns: frame.image for frame in frames}
    images = [by_stamp[encoded.stamp_ns] for encoded in window.frames]
    fit = fit_image(*images[0].shape[:2], WIDTH)
    with torch.inference_mode():
        return model(to_tensor(np.stack([fit.apply(image) for image in images]))[None]).numpy()


@pytest.fixture
def tensor_bytes() -> Iterator[Callable[[], int]]:
    """Return a function that counts the bytes of all tensors created by the test."""
    def count() -> int:
        gc.collect()
        storages = [each.untyped_storage() for each in gc.get_objects() if type(each) is Tensor]
        return sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values())

    small_model()
    gc.collect()
    gc.freeze()
    yield count
    gc.unfreeze()


@pytest.fixture(scope='module')
def recorded() -> SimpleNamespace:
    """Stamps and differences to recomputation of every window, and frames computed per module."""
    model, reference = small_model(), copy.deepcopy(small_model())
    backbone, windows, differences = VggtBackbone(model, WIDTH), [], []
    with record_calls(dinov2=model.aggregator.patch_embed,
                      frame=model.aggregator.frame_blocks[0]) as calls:
        for window in iterate_windows(backbone, FRAMES, KEEPS):
            if window is not None:
                found = backbone.pose_encodings([window])
                expected = recompute(reference, window, FRAMES)
                differences.append(np.abs(found - expected).max())
                windows.append(window)
    work = {name: sum(len(given) for given, _ in each) for name, each in calls.items()}
    stamps = [[encoded.stamp_ns for encoded in window.frames] for window in windows]
    return SimpleNamespace(stamps=stamps, differences=differences, work=work)


def test_some_frames_are_kept_and_some_dropped(recorded):
    assert 10 < KEEPS.sum() < 20
    assert [len(stamps) for stamps in recorded.stamps] == [
        min(size, WINDOW) for size in range(2, COUNT + 1)]
    anchors = [stamps[0] for stamps in recorded.stamps]
    assert len(set(anchors)) == 1 + KEEPS[:-1].sum()  # the last decision changes no window


def test_poses_equal_those_of_recomputation(recorded):
    assert len(recorded.differences) == COUNT - 1
    assert max(recorded.differences) < 5e-6


def test_poses_depend_on_the_frames_of_the_window():
    """Otherwise the comparison above would show nothing."""
    backbone = VggtBackbone(small_model(), WIDTH)
    one, other, rotated = (
        backbone.pose_encodings([make_window(backbone, frames)])[-1, 0] for frames in (
            FRAMES[:4], (*FRAMES[:3], FRAMES[4]), (*FRAMES[1:4], FRAMES[0])))
    assert np.abs(one[:3] - other[:3]).max() > 1e-4
    assert np.abs(one[0] - rotated[3]).max() > 1e-2


def test_each_frame_is_encoded_once_and_computed_once_per_role(recorded):
    roles = {(stamp, index == 0) for stamps in recorded.stamps
             for index, stamp in enumerate(stamps)}
    assert recorded.work == {'dinov2': COUNT, 'frame': len(roles)}
    assert len(roles) < 2 * COUNT < sum(map(len, recorded.stamps)) / 2


def test_without_reuse_every_window_is_computed_in_full():
    model = small_model()
    backbone = VggtBackbone(model, WIDTH, reuse=False)
    window = make_window(backbone, FRAMES[:4])
    with record_calls(dinov2=model.aggregator.patch_embed) as calls:
        found = backbone.pose_encodings([window])
        assert sum(len(given) for given, _ in calls['dinov2']) == 4
    assert np.array_equal(found, recompute(model, window, FRAMES))


@pytest.mark.parametrize('reuse', [True, False])
def test_memory_is_that_of_one_window(reuse, tensor_bytes):
    steps, held = iterate_windows(VggtBackbone(small_model(), WIDTH, reuse), FRAMES, KEEPS), []
    for _ in steps:
        held.append(tensor_bytes())
    assert 0 < held[0] < held[1] < held[2]
    assert set(held[WINDOW:]) == {held[WINDOW]}  # independent of the decisions
    assert held[WINDOW] <= WINDOW * (IMAGE_BYTES + 5 * TOKENS_BYTES)
    steps.close()
    del steps, _
    assert tensor_bytes() == 0


def test_releasing_a_frame_frees_it(tensor_bytes):
    backbone = VggtBackbone(small_model(), WIDTH)
    window = make_window(backbone, FRAMES[:3])
    encoded_bytes = tensor_bytes()
    backbone.pose_encodings([window])
    cached_bytes = tensor_bytes()
    assert 0 < encoded_bytes < cached_bytes
    for left, encoded in zip((2, 1, 0), window.frames, strict=True):
        window.stream.release(encoded)
        assert tensor_bytes() == cached_bytes * left // 3


def test_many_windows_in_one_call_equal_single_ones():
    backbone = VggtBackbone(small_model(), WIDTH)
    others = noise_frames(8, seed=1)
    tall = noise_frames(3, seed=2, height=80, width=60)
    windows = [make_window(backbone, frames) for frames in (
        FRAMES[:4], others[:3], others[2:6], tall, FRAMES[5:8])]
    together = backbone.estimate(windows)
    for window, estimate in zip(windows, together, strict=True):
        alone, = backbone.estimate([window])
        assert estimate.T_anchor_frame.shape == (len(window.frames), 4, 4)
        for name in ('T_anchor_frame', 'covariance', 'intrinsics'):
            np.testing.assert_allclose(getattr(estimate, name), getattr(alone, name), atol=1e-6,
                                       rtol=1e-5)
    assert np.abs(together[0].T_anchor_frame - together[2].T_anchor_frame).max() > 1e-3
    assert backbone.estimate([]) == []


def test_reuse_in_bfloat16_is_near_recomputation():
    model = with_precision(small_model(), torch.bfloat16)
    backbone = VggtBackbone(model, WIDTH)
    window = make_window(backbone, FRAMES[:WINDOW])
    found, plain = backbone.pose_encodings([window]), recompute(model, window, FRAMES)
    full = recompute(small_model(), window, FRAMES)
    assert np.abs(found - plain).max() < 2e-3
    assert 1e-5 < np.abs(found - full).max() < 2e-2
