# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Batches of many streams: the results of single frames and windows, in one forward pass."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from odometry_scenes import frames_of
from vggt_models import (
    WIDTH,
    Tensor,
    make_window,
    noise_frames,
    record_calls,
    small_model,
    torch,
    with_precision,
)

from kfvo_ros.backbones.base import Encoded, Status, Window
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.vggt.backbone import VggtBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Frame

ENVIRONMENTS = 20
SIZES = {'landscape': (60, 80), 'double': (120, 160), 'portrait': (80, 60), 'wide': (37, 122)}
"""(height, width); the first two have one fitted size."""


@pytest.fixture(scope='module')
def backbone() -> VggtBackbone:
    return VggtBackbone(small_model(), WIDTH)


def first_frames(*sizes: str) -> list[Frame]:
    """Return the first frames of different sequences, one per size."""
    return [noise_frames(1, seed, *SIZES[size])[0] for seed, size in enumerate(sizes)]


def encode_batch(backbone: VggtBackbone, frames: Sequence[Frame]) -> list[Encoded]:
    """Encode first frames of new streams in one call."""
    return backbone.encode([(backbone.open(None), frame) for frame in frames])


def tensors(encoded: Encoded) -> list[Tensor]:
    """Return the tensors of a frame before any estimate."""
    return [encoded.payload.image, encoded.payload.patches]


def differences(one: Encoded, other: Encoded) -> Iterator[float]:
    """Yield the largest difference of the descriptors and of each tensor."""
    yield np.abs(one.descriptor - other.descriptor).max()
    for batched, single in zip(tensors(one), tensors(other), strict=True):
        assert (batched.shape, batched.dtype) == (single.shape, single.dtype)
        yield (batched - single).abs().max().item()


@pytest.mark.parametrize('sizes', [
    ('landscape', 'landscape'), ('landscape', 'portrait', 'double'),
    ('wide', 'landscape', 'portrait', 'landscape', 'wide')], ids=len)
@pytest.mark.parametrize(('dtype', 'bound'), [(torch.float32, 1e-5), (torch.bfloat16, 5e-2)])
def test_a_batch_equals_single_frames(sizes, dtype, bound):
    backbone = VggtBackbone(with_precision(small_model(), dtype), WIDTH)
    frames = first_frames(*sizes)
    found = encode_batch(backbone, frames)
    alone = [backbone.open(None).encode(frame) for frame in frames]
    for batched, single in zip(found, alone, strict=True):
        assert batched.stamp_ns == single.stamp_ns
        assert batched.descriptor.dtype == np.float32
        assert batched.payload.fit == single.payload.fit
        assert batched.payload.grid == single.payload.grid
        assert max(differences(batched, single)) < bound
    assert np.abs(found[0].descriptor - found[1].descriptor).max() > 0.1


def test_windows_of_batches_equal_those_of_single_frames(backbone):
    sequences = [noise_frames(4, seed, *SIZES[size])
                 for seed, size in enumerate(('landscape', 'portrait', 'landscape'))]
    streams = [backbone.open(None) for _ in sequences]
    steps = [backbone.encode(list(zip(streams, frames))) for frames in zip(*sequences)]
    found = backbone.estimate([Window(stream, frames)
                               for stream, frames in zip(streams, zip(*steps))])
    for frames, estimate in zip(sequences, found, strict=True):
        alone, = backbone.estimate([make_window(backbone, frames)])
        assert estimate.status is Status.OK
        np.testing.assert_allclose(estimate.T_anchor_frame, alone.T_anchor_frame, atol=1e-5)
        np.testing.assert_allclose(estimate.intrinsics, alone.intrinsics, rtol=1e-4)


@pytest.mark.parametrize(('sizes', 'batches'), [
    (['landscape'] * ENVIRONMENTS, [ENVIRONMENTS]), (['landscape', 'double'] * 10, [ENVIRONMENTS]),
    (['portrait', 'landscape', 'landscape', 'wide', 'portrait', 'double'], [2, 3, 1])],
    ids=['alike', 'alike once fitted', 'three sizes'])
def test_one_forward_for_each_fitted_size(sizes, batches, backbone):
    frames = first_frames(*sizes)
    with record_calls(dinov2=small_model().aggregator.patch_embed) as calls:
        encode_batch(backbone, frames)
    assert [len(images) for images, _ in calls['dinov2']] == batches


def test_each_frame_owns_its_memory(backbone):
    """Releasing one frees its tensors while others of its batch live."""
    encoded = encode_batch(backbone, first_frames(*['landscape'] * 4))
    assert all(each.descriptor.base is None for each in encoded)
    sizes = [(tensor.untyped_storage().nbytes(), tensor.nbytes)
             for each in encoded for tensor in tensors(each)]
    assert all(held == own > 0 for held, own in sizes)
    addresses = {tensor.untyped_storage().data_ptr()
                 for each in encoded for tensor in tensors(each)}
    assert len(addresses) == len(sizes)
    released = [weakref.ref(tensor) for tensor in tensors(encoded[1])]
    backbone.open(None).release(encoded[1])
    gc.collect()
    assert [reference() for reference in released] == [None, None]
    assert all(each.payload.patches is not None for each in (encoded[0], *encoded[2:]))


def test_a_size_other_than_the_streams_is_refused(backbone):
    right, wrong = backbone.open(None), backbone.open(None)
    landscape, portrait = first_frames('landscape', 'portrait')
    backbone.encode([(right, landscape), (wrong, portrait)])
    with pytest.raises(KfvoError, match='expected images of 60x80 as before, 80x60 came'):
        backbone.encode([(right, landscape), (wrong, landscape)])
    again = backbone.encode([(right, landscape), (wrong, portrait)])  # the streams continue
    assert [each.payload.grid for each in again] == [(4, 5), (5, 5)]
    with pytest.raises(KfvoError, match='at most 16 times as high as wide'):
        backbone.encode([(right, landscape),
                         (backbone.open(None), Frame(1, np.zeros((170, 10), np.uint8), None))])


def test_an_empty_batch(backbone):
    assert backbone.encode([]) == []


def test_each_window_has_its_share_of_the_batchs_time(backbone):
    windows = [make_window(backbone, noise_frames(3, seed)) for seed in (0, 1)]
    estimates = backbone.estimate(windows)
    shares = [estimate.durations['head'] for estimate in estimates]
    assert shares[0] == shares[1] > 0.0


def test_streams_of_another_backbone_are_refused(backbone):
    frame = frames_of(1)[0]
    with pytest.raises(TypeError, match='GeometricStream'):
        backbone.encode([(GeometricBackbone().open(frame.camera), frame)])


def test_a_backbone_without_batches_encodes_one_by_one():
    backbone, sequences = GeometricBackbone(), (frames_of(1)[:3], frames_of(2)[:3])
    streams, single_streams = ([backbone.open(frames[0].camera) for frames in sequences]
                               for _ in range(2))
    for frames in zip(*sequences):
        found = backbone.encode(list(zip(streams, frames)))
        alone = [stream.encode(frame) for stream, frame in zip(single_streams, frames)]
        for batched, single in zip(found, alone, strict=True):
            assert batched.stamp_ns == single.stamp_ns
            assert np.array_equal(batched.descriptor, single.descriptor)
            assert np.array_equal(batched.tracks.pixels, single.tracks.pixels)
            assert len(batched.tracks.ids) > 50
