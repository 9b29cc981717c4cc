# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a sliding window reuses: the same poses, less work, and memory for one window."""

from __future__ import annotations

import copy
import gc
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace

import numpy as np
import pytest
from odometry_scenes import Scripted
from vggt_models import (
    WIDTH,
    Tensor,
    changed,
    frames_seen,
    listening,
    small_model,
    to_tensor,
    torch,
    window_of,
)

from kfvo_ros.backbones.base import Window
from kfvo_ros.backbones.vggt.backbone import VggtBackbone
from kfvo_ros.backbones.vggt.config import SPECIAL
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.backbones.vggt.preprocessing import fit
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.sequences.base import Frame

DECISIONS, WINDOW = 30, 8
COUNT = WINDOW - 1 + DECISIONS
KEEPS = np.random.default_rng(4).random(DECISIONS) < 0.5
FRAMES = frames_seen(COUNT)
IMAGE_BYTES, TOKENS_BYTES = 4 * 3 * 56 * 70, 4 * (SPECIAL + 4 * 5) * 128
"""Of one frame: what the small model makes of it are float32 too."""


def driven(backbone: VggtBackbone, frames: Sequence[Frame], keeps: Sequence[bool]
           ) -> Iterator[Window | None]:
    """Drive an odometry as `process` does; give its window before each estimate."""
    odometry = KeyframeOdometry(backbone, Scripted(*keeps), window_size=WINDOW)
    for frame in frames:
        window = odometry.begin(frame)
        yield window
        decision = odometry.integrate(backbone.estimate([window])[0] if window else None)
        odometry.commit(decision if isinstance(decision, bool)
                        else odometry.policy.decide(decision), {})


def anew(model: Vggt, window: Window, frames: Sequence[Frame]) -> np.ndarray:
    """Return the encodings that the model as published gives, from the images alone."""
    seen = {frame.stamp_ns: frame.image for frame in frames}
    images = [seen[encoded.stamp_ns] for encoded in window.frames]
    fitted = fit(*images[0].shape[:2], WIDTH)
    with torch.inference_mode():
        return model(to_tensor(np.stack([fitted.apply(image) for image in images]))[None]).numpy()


@pytest.fixture
def tensor_bytes() -> Iterator[Callable[[], int]]:
    """Return a function that tells what tensors made since the test's begin hold."""
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
def drive() -> SimpleNamespace:
    """Return what came of every window of a drive, and what was computed for it."""
    model, reference = small_model(), copy.deepcopy(small_model())
    backbone, windows, differences = VggtBackbone(model, WIDTH), [], []
    with listening(trunk=model.aggregator.patch_embed, frame=model.aggregator.frame_blocks[0]
                   ) as heard:
        for window in driven(backbone, FRAMES, KEEPS):
            if window is not None:
                found, plain = backbone.encodings([window]), anew(reference, window, FRAMES)
                differences.append(np.abs(found - plain).max())
                windows.append(window)
    work = {name: sum(len(given) for given, _ in calls) for name, calls in heard.items()}
    stamps = [[encoded.stamp_ns for encoded in window.frames] for window in windows]
    return SimpleNamespace(stamps=stamps, differences=differences, work=work)


def test_the_drive_keeps_and_drops(drive):
    assert 10 < KEEPS.sum() < 20
    assert [len(stamps) for stamps in drive.stamps] == [min(n, WINDOW) for n in
                                                        range(2, COUNT + 1)]
    anchors = [stamps[0] for stamps in drive.stamps]
    assert len(set(anchors)) == 1 + KEEPS[:-1].sum()  # the last one is of no window any more


def test_poses_are_those_of_the_plain_model(drive):
    assert len(drive.differences) == COUNT - 1
    assert max(drive.differences) < 5e-6


def test_poses_depend_on_what_is_in_the_window():
    """Else the comparison above would tell nothing."""
    backbone = VggtBackbone(small_model(), WIDTH)
    one, other, turned = (backbone.encodings([window_of(backbone, frames)])[-1, 0] for frames in (
        FRAMES[:4], (*FRAMES[:3], FRAMES[4]), (*FRAMES[1:4], FRAMES[0])))
    assert np.abs(one[:3] - other[:3]).max() > 1e-4
    assert np.abs(one[0] - turned[3]).max() > 1e-2


def test_each_frame_is_seen_once_and_once_in_each_role(drive):
    roles = {(stamp, index == 0) for stamps in drive.stamps for index, stamp in enumerate(stamps)}
    assert drive.work == {'trunk': COUNT, 'frame': len(roles)}
    assert len(roles) < 2 * COUNT < sum(map(len, drive.stamps)) / 2


def test_without_reuse_all_is_computed_every_time():
    model = small_model()
    backbone = VggtBackbone(model, WIDTH, reuse=False)
    window = window_of(backbone, FRAMES[:4])
    with listening(trunk=model.aggregator.patch_embed) as heard:
        found = backbone.encodings([window])
        assert sum(len(given) for given, _ in heard['trunk']) == 4
    assert np.array_equal(found, anew(model, window, FRAMES))


@pytest.mark.parametrize('reuse', [True, False])
def test_memory_is_that_of_one_window(reuse, tensor_bytes):
    steps, held = driven(VggtBackbone(small_model(), WIDTH, reuse), FRAMES, KEEPS), []
    for _ in steps:
        held.append(tensor_bytes())
    assert 0 < held[0] < held[1] < held[2]
    assert set(held[WINDOW:]) == {held[WINDOW]}  # whatever was kept or dropped before
    assert held[WINDOW] <= WINDOW * (IMAGE_BYTES + 5 * TOKENS_BYTES)
    steps.close()
    del steps, _
    assert tensor_bytes() == 0


def test_releasing_a_frame_frees_it(tensor_bytes):
    backbone = VggtBackbone(small_model(), WIDTH)
    window = window_of(backbone, FRAMES[:3])
    seen = tensor_bytes()
    backbone.encodings([window])
    placed = tensor_bytes()
    assert 0 < seen < placed
    for left, encoded in zip((2, 1, 0), window.frames, strict=True):
        window.stream.release(encoded)
        assert tensor_bytes() == placed * left // 3


def test_many_windows_in_one_call_equal_single_ones():
    backbone = VggtBackbone(small_model(), WIDTH)
    others = frames_seen(8, seed=1)
    tall = frames_seen(3, seed=2, height=80, width=60)
    windows = [window_of(backbone, frames) for frames in (
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


def test_in_bfloat16_reuse_is_near_too():
    model = changed(small_model(), torch.bfloat16)
    backbone = VggtBackbone(model, WIDTH)
    window = window_of(backbone, FRAMES[:WINDOW])
    found, plain = backbone.encodings([window]), anew(model, window, FRAMES)
    full = anew(small_model(), window, FRAMES)
    assert np.abs(found - plain).max() < 2e-3
    assert 1e-5 < np.abs(found - full).max() < 2e-2
