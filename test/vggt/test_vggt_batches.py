# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many streams encoded in one call: what each alone would give, for one forward of the trunk."""

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
    changed,
    frames_seen,
    listening,
    small_model,
    torch,
    window_of,
)

from kfvo_ros.backbones.base import Encoded, Status, Window
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.vggt.backbone import VggtBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Frame

ENVIRONMENTS = 20
SIZES = {'landscape': (60, 80), 'double': (120, 160), 'portrait': (80, 60), 'wide': (37, 122)}
"""(height, width); the first two are of one size once they are fitted."""


@pytest.fixture(scope='module')
def backbone() -> VggtBackbone:
    return VggtBackbone(small_model(), WIDTH)


def firsts(*sizes: str) -> list[Frame]:
    """Return the first frame of as many sequences, no two alike."""
    return [frames_seen(1, seed, *SIZES[size])[0] for seed, size in enumerate(sizes)]


def together(backbone: VggtBackbone, frames: Sequence[Frame]) -> list[Encoded]:
    """Encode in one call the first frames of as many new streams."""
    return backbone.encode([(backbone.open(None), frame) for frame in frames])


def tensors(encoded: Encoded) -> list[Tensor]:
    """Return what is held for a frame before any estimate."""
    return [encoded.payload.image, encoded.payload.patches]


def differences(one: Encoded, other: Encoded) -> Iterator[float]:
    """Give the largest difference of the descriptors and of each tensor."""
    yield np.abs(one.descriptor - other.descriptor).max()
    for mine, yours in zip(tensors(one), tensors(other), strict=True):
        assert (mine.shape, mine.dtype) == (yours.shape, yours.dtype)
        yield (mine - yours).abs().max().item()


@pytest.mark.parametrize('sizes', [
    ('landscape', 'landscape'), ('landscape', 'portrait', 'double'),
    ('wide', 'landscape', 'portrait', 'landscape', 'wide')], ids=len)
@pytest.mark.parametrize(('dtype', 'bound'), [(torch.float32, 1e-5), (torch.bfloat16, 5e-2)])
def test_a_batch_equals_single_frames(sizes, dtype, bound):
    backbone = VggtBackbone(changed(small_model(), dtype), WIDTH)
    frames = firsts(*sizes)
    found = together(backbone, frames)
    alone = [backbone.open(None).encode(frame) for frame in frames]
    for mine, yours in zip(found, alone, strict=True):
        assert mine.stamp_ns == yours.stamp_ns
        assert mine.descriptor.dtype == np.float32
        assert mine.payload.fit == yours.payload.fit
        assert mine.payload.grid == yours.payload.grid
        assert max(differences(mine, yours)) < bound
    assert np.abs(found[0].descriptor - found[1].descriptor).max() > 0.1


def test_windows_of_batches_are_placed_as_those_of_single_frames(backbone):
    sequences = [frames_seen(4, seed, *SIZES[size])
                 for seed, size in enumerate(('landscape', 'portrait', 'landscape'))]
    streams = [backbone.open(None) for _ in sequences]
    steps = [backbone.encode(list(zip(streams, frames))) for frames in zip(*sequences)]
    found = backbone.estimate([Window(stream, frames)
                               for stream, frames in zip(streams, zip(*steps))])
    for frames, estimate in zip(sequences, found, strict=True):
        alone, = backbone.estimate([window_of(backbone, frames)])
        assert estimate.status is Status.OK
        np.testing.assert_allclose(estimate.T_anchor_frame, alone.T_anchor_frame, atol=1e-5)
        np.testing.assert_allclose(estimate.intrinsics, alone.intrinsics, rtol=1e-4)


@pytest.mark.parametrize(('sizes', 'batches'), [
    (['landscape'] * ENVIRONMENTS, [ENVIRONMENTS]), (['landscape', 'double'] * 10, [ENVIRONMENTS]),
    (['portrait', 'landscape', 'landscape', 'wide', 'portrait', 'double'], [2, 3, 1])],
    ids=['alike', 'alike once fitted', 'three sizes'])
def test_one_forward_for_each_fitted_size(sizes, batches, backbone):
    frames = firsts(*sizes)
    with listening(trunk=small_model().aggregator.patch_embed) as heard:
        together(backbone, frames)
    assert [len(images) for images, _ in heard['trunk']] == batches


def test_each_frame_owns_its_memory(backbone):
    """So one that is released frees all that was its own, while others of its batch live."""
    encoded = together(backbone, firsts(*['landscape'] * 4))
    assert all(each.descriptor.base is None for each in encoded)
    sizes = [(tensor.untyped_storage().nbytes(), tensor.nbytes)
             for each in encoded for tensor in tensors(each)]
    assert all(held == own > 0 for held, own in sizes)
    places = {tensor.untyped_storage().data_ptr() for each in encoded for tensor in tensors(each)}
    assert len(places) == len(sizes)
    released = [weakref.ref(tensor) for tensor in tensors(encoded[1])]
    backbone.open(None).release(encoded[1])
    gc.collect()
    assert [reference() for reference in released] == [None, None]
    assert all(each.payload.patches is not None for each in (encoded[0], *encoded[2:]))


def test_the_stream_of_a_wrong_size_is_told(backbone):
    right, wrong = backbone.open(None), backbone.open(None)
    landscape, portrait = firsts('landscape', 'portrait')
    backbone.encode([(right, landscape), (wrong, portrait)])
    with pytest.raises(KfvoError, match='expected images of 60x80 as before, 80x60 came'):
        backbone.encode([(right, landscape), (wrong, landscape)])
    again = backbone.encode([(right, landscape), (wrong, portrait)])  # they go on
    assert [each.payload.grid for each in again] == [(4, 5), (5, 5)]
    with pytest.raises(KfvoError, match='at most 16 times as high as wide'):
        backbone.encode([(right, landscape),
                         (backbone.open(None), Frame(1, np.zeros((170, 10), np.uint8), None))])


def test_nobody_is_no_batch(backbone):
    assert backbone.encode([]) == []


def test_streams_of_another_backbone_are_refused(backbone):
    frame = frames_of(1)[0]
    with pytest.raises(TypeError, match='GeometricStream'):
        backbone.encode([(GeometricBackbone().open(frame.camera), frame)])


def test_a_backbone_without_batches_takes_one_frame_after_the_other():
    backbone, sequences = GeometricBackbone(), (frames_of(1)[:3], frames_of(2)[:3])
    streams, single = ([backbone.open(frames[0].camera) for frames in sequences] for _ in range(2))
    for frames in zip(*sequences):
        found = backbone.encode(list(zip(streams, frames)))
        alone = [stream.encode(frame) for stream, frame in zip(single, frames)]
        for mine, yours in zip(found, alone, strict=True):
            assert mine.stamp_ns == yours.stamp_ns
            assert np.array_equal(mine.descriptor, yours.descriptor)
            assert np.array_equal(mine.tracks.pixels, yours.tracks.pixels)
            assert len(mine.tracks.ids) > 50
