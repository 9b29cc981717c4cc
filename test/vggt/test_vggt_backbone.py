# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT against the contract of a backbone, and in the odometry."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from odometry_scenes import Scripted
from vggt_models import WIDTH, changed, frames_seen, small_model, to_tensor, torch, window_of

from kfvo_ros.backbones.base import LOST_VARIANCE, Estimate, Status, Window, WindowPrior
from kfvo_ros.backbones.vggt import camera_head
from kfvo_ros.backbones.vggt.backbone import VggtBackbone, load_backbone
from kfvo_ros.backbones.vggt.preprocessing import fit
from kfvo_ros.errors import KfvoError
from kfvo_ros.images import to_grey
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.odometry.scale import ScaleAligner, compare_translations
from kfvo_ros.odometry.window_prior import scale_poses

FRAMES = frames_seen(14)


@pytest.fixture(scope='module')
def backbone() -> VggtBackbone:
    return VggtBackbone(small_model(), WIDTH)


@pytest.fixture(scope='module')
def windows(backbone) -> list[Window]:
    """Return windows of landscape and portrait images."""
    return [window_of(backbone, frames) for frames in (
        FRAMES[:8], FRAMES[5:7], frames_seen(5, seed=1, height=90, width=60))]


def broken(**changes: float) -> VggtBackbone:
    """Return a backbone with some parameters of the camera head all of one value."""
    model = copy.deepcopy(small_model())
    for name, value in changes.items():
        model.camera_head.get_parameter(name.replace('__', '.')).fill_(value)
    return VggtBackbone(model, WIDTH)


def test_encoding_is_the_cls_token(backbone):
    encoded = backbone.open(None).encode(FRAMES[0])
    assert encoded.stamp_ns == FRAMES[0].stamp_ns
    assert encoded.tracks is None
    assert encoded.descriptor.shape == (backbone.descriptor_size,) == (128,)
    assert encoded.descriptor.dtype == np.float32
    image = to_tensor(fit(60, 80, WIDTH).apply(FRAMES[0].image)[None])
    with torch.inference_mode():
        cls = small_model().aggregator.see(image)[0, 0].numpy()
    assert np.array_equal(encoded.descriptor, cls)
    assert not np.allclose(cls, backbone.open(None).encode(FRAMES[1]).descriptor, atol=1e-2)


def test_grey_is_colour_three_times_the_same(backbone):
    """The camera of the frames is never asked for."""
    assert not backbone.needs_camera
    grey = [replace(frame, image=to_grey(frame.image)) for frame in FRAMES[:3]]
    colour = [replace(frame, image=frame.image[..., None].repeat(3, axis=2)) for frame in grey]
    one, other = (backbone.estimate([window_of(backbone, frames)])[0]
                  for frames in (grey, colour))
    assert np.array_equal(one.T_anchor_frame, other.T_anchor_frame)
    mixed = backbone.estimate([window_of(backbone, FRAMES[:3])])[0]
    assert not np.array_equal(one.T_anchor_frame, mixed.T_anchor_frame)


def test_shapes_and_first_pose(backbone, windows):
    for window, estimate in zip(windows, backbone.estimate(windows), strict=True):
        size = len(window.frames)
        assert estimate.status is Status.OK
        assert estimate.T_anchor_frame.shape == (size, 4, 4)
        assert estimate.T_anchor_frame.dtype == np.float64
        assert np.array_equal(estimate.T_anchor_frame[0], np.eye(4))
        rotations = estimate.T_anchor_frame[:, :3, :3]
        np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2),
                                   np.tile(np.eye(3), (size, 1, 1)), atol=1e-12)
        assert (np.linalg.norm(estimate.T_anchor_frame[1:, :3, 3], axis=1) > 1e-3).all()
        assert estimate.signals.shape == (len(backbone.signal_names),)
        assert estimate.points is None


def test_poses_are_relative_to_the_first_camera(backbone, windows):
    """The model's world is only nearly that, so every extrinsic counts, the first too."""
    encodings = backbone.encodings(windows[:1])[-1, 0]
    T_camera_world = camera_head.decode_transforms(encodings)
    assert np.abs(T_camera_world[0] - np.eye(4)).max() > 1e-3
    found = backbone.estimate(windows[:1])[0].T_anchor_frame
    np.testing.assert_allclose(T_camera_world @ np.linalg.inv(T_camera_world[0]) @ found,
                               np.tile(np.eye(4), (8, 1, 1)), atol=1e-9)


def test_covariance_is_positive_but_for_the_anchor(backbone, windows):
    for estimate in backbone.estimate(windows):
        covariance = estimate.covariance
        assert covariance.shape == (len(estimate.T_anchor_frame), 6, 6)
        assert not covariance[0].any()
        assert np.array_equal(covariance, np.swapaxes(covariance, 1, 2))
        assert (np.linalg.eigvalsh(covariance[1:]) > 0.0).all()
        assert len(np.unique(covariance[1:, 0, 0])) == len(covariance) - 1  # it follows the data


def test_estimate_has_no_side_effects(backbone, windows):
    first, again = (backbone.estimate(windows)[0] for _ in range(2))
    assert np.array_equal(first.T_anchor_frame, again.T_anchor_frame)


@pytest.mark.parametrize('hinted', [False, True])
def test_poses_that_are_no_numbers_are_lost(hinted):
    backbone = broken(pose_branch__fc2__bias=float('nan'))
    window = window_of(backbone, FRAMES[:4])
    known = np.tile(np.eye(4), (3, 1, 1))
    known[:, 0, 3] = np.arange(3)
    if hinted:
        window = replace(window, previous=WindowPrior(known, known[2], None))
    estimate, = backbone.estimate([window])
    assert estimate.status is Status.LOST
    expected = [*known, known[2]] if hinted else [np.eye(4)] * 4
    assert np.array_equal(estimate.T_anchor_frame, expected)
    assert np.array_equal(estimate.covariance[1:], [LOST_VARIANCE * np.eye(6)] * 3)


def test_a_rotation_of_length_zero_is_lost():
    backbone = broken(pose_branch__fc2__weight=0.0, pose_branch__fc2__bias=0.0)
    estimate, = backbone.estimate([window_of(backbone, FRAMES[:3])])
    assert estimate.status is Status.LOST
    assert np.isfinite(estimate.T_anchor_frame).all() and np.isfinite(estimate.covariance).all()


def test_an_odometry_survives_a_model_of_no_numbers():
    backbone = broken(trunk_norm__weight=float('nan'))
    odometry = KeyframeOdometry(backbone, Scripted(True))
    updates = [odometry.process(frame) for frame in FRAMES]
    assert {update.status for update in updates[1:]} == {Status.LOST}
    assert all(np.isfinite(update.T_world_camera).all() for update in updates)


@pytest.mark.parametrize(('height', 'width'), [(60, 80), (90, 60), (37, 122)])
def test_intrinsics_are_those_of_the_native_image(height, width, backbone):
    """A ray of the fitted image goes through the same place of the native one."""
    frames = frames_seen(3, seed=1, height=height, width=width)
    window = window_of(backbone, frames)
    fitted = fit(height, width, WIDTH)
    assert (fitted.first > 0) == (height > width)
    encodings = backbone.encodings([window])[-1, 0, -1]
    inner = camera_head.decode_intrinsics(encodings, fitted.rows, WIDTH)
    K = backbone.estimate([window])[0].intrinsics
    ray = np.array([0.02, -0.03, 1.0])
    u, v, _ = inner @ ray
    np.testing.assert_allclose(
        K @ ray, [u * width / WIDTH, (v + fitted.first) * height / fitted.height, 1.0])
    np.testing.assert_allclose(K[:2, 2], [width / 2, height / 2], atol=height / fitted.height)
    assert K[0, 1] == K[1, 0] == 0.0


def test_a_mark_is_where_the_intrinsics_say():
    image = np.zeros((640, 480), dtype=np.uint8)
    image[300:304, 100:104] = 255
    fitted = fit(640, 480, 140)
    seen = fitted.apply(image)[..., 0].astype(float)
    assert seen.shape == (140, 140)
    v, u = (np.average(axis + 0.5, weights=seen) for axis in np.indices(seen.shape))
    x, y, _ = fitted.native(np.eye(3)) @ [u, v, 1.0]
    assert (x, y) == (pytest.approx(102.0, abs=0.7), pytest.approx(302.0, abs=0.7))


def test_a_stream_has_one_size_of_images(backbone):
    stream = backbone.open(None)
    stream.encode(FRAMES[0])
    with pytest.raises(KfvoError, match='80x60 as before, 60x90 came'):
        stream.encode(frames_seen(1, height=90, width=60)[0])
    stream.encode(FRAMES[1])  # it goes on
    backbone.open(None).encode(frames_seen(1, height=90, width=60)[0])


def test_released_frames_hold_nothing(backbone):
    window = window_of(backbone, FRAMES[:2])
    backbone.estimate([window])
    payload = window.frames[0].payload
    assert any(isinstance(each, torch.Tensor) for each in vars(payload).values())
    window.stream.release(window.frames[0])
    assert not any(isinstance(each, torch.Tensor | tuple) for name, each in vars(payload).items()
                   if name not in ('fit', 'grid'))
    window.stream.release(window.frames[0])  # once more does no harm


# In float16, as loaded: the half precision that has fewer exponents


@pytest.mark.parametrize('reuse', [True, False])
@pytest.mark.parametrize('size', [2, 8])
def test_float16_is_near(size, reuse, small_vggt):
    """At most 1.6e-3 away was seen on a processor; bfloat16 is up to ten times as far."""
    half, exact = (load_backbone(str(small_vggt), None, 'cpu', precision, WIDTH, reuse, size)
                   for precision in ('fp16', 'fp32'))
    assert half.condition()['precision'] == 'float16'
    for seed in range(2):
        frames = frames_seen(size, seed)
        found, right = (each.estimate([window_of(each, frames)])[0] for each in (half, exact))
        assert found.status is Status.OK
        assert np.isfinite(found.T_anchor_frame).all() and np.isfinite(found.covariance).all()
        assert 1e-5 < np.abs(found.T_anchor_frame - right.T_anchor_frame).max() < 5e-3
        np.testing.assert_allclose(found.intrinsics, right.intrinsics, rtol=3e-3)


@pytest.mark.parametrize(('dtype', 'status'), [
    (torch.float32, Status.OK), (torch.bfloat16, Status.OK), (torch.float16, Status.LOST)])
def test_what_float16_cannot_hold_is_lost(dtype, status):
    model = changed(small_model(), dtype)
    model.aggregator.patch_embed.blocks[0].norm2.weight.mul_(1e6)  # float16 ends at 65504
    backbone = VggtBackbone(model, WIDTH)
    estimate, = backbone.estimate([window_of(backbone, FRAMES[:3])])
    assert estimate.status is status
    assert np.isfinite(estimate.T_anchor_frame).all()


# In the odometry


class Aligner(ScaleAligner):
    """Keeps what it was given and what it answered."""

    def __init__(self, rule: str) -> None:
        super().__init__(rule)
        self.answers: list[tuple[Estimate, WindowPrior | None, float]] = []

    def align(self, estimate: Estimate, previous: WindowPrior | None) -> float:
        """Answer as ever."""
        self.answers.append((estimate, previous, super().align(estimate, previous)))
        return self.answers[-1][2]

    def ratios(self) -> list[float | None]:
        """Return the known size of each window per size as aligned, where one is known.

        None where this random model places the frames quite otherwise, as from another anchor.
        """
        return [compare_translations(previous.T_anchor_frame,
                                     scale_poses(estimate.T_anchor_frame, scale))
                for estimate, previous, scale in self.answers if previous is not None]


def aligned(rule: str | None, backbone: VggtBackbone) -> Aligner:
    """Return what aligned the windows of an odometry that keeps every other frame."""
    odometry = KeyframeOdometry(backbone, Scripted(*[True, False] * 4), rule)
    odometry.scale = Aligner(odometry.scale.rule)
    for frame in FRAMES:
        odometry.process(frame)
    return odometry.scale


def test_windows_are_brought_to_one_scale(backbone):
    aligner = aligned(None, backbone)
    assert aligner.rule == backbone.default_scale_rule == 'translation'
    hinted = [previous is not None for _, previous, _ in aligner.answers]
    assert hinted == [False] + [True] * (len(FRAMES) - 2)  # from the third frame on
    scales, ratios = [scale for _, _, scale in aligner.answers], aligner.ratios()
    told = [ratio for ratio in ratios if ratio is not None]
    assert len(told) >= 8
    np.testing.assert_allclose(told, 1.0, rtol=1e-6)
    for before, scale, ratio in zip(scales[:-1], scales[1:], ratios, strict=True):
        assert ratio is not None or scale == before


def test_the_models_own_scale_can_be_taken(backbone):
    aligner = aligned('none', backbone)
    assert {scale for _, _, scale in aligner.answers} == {1.0}
    told = [ratio for ratio in aligner.ratios() if ratio is not None]
    assert np.abs(np.log(told)).max() > 0.01  # so there was something to align
