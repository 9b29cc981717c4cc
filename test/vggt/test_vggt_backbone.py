# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The VGGT backbone: estimates, intrinsics, covariances, float16, and use in the odometry."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from odometry_scenes import ScriptedPolicy
from vggt_models import (
    WIDTH,
    make_window,
    noise_frames,
    small_model,
    to_tensor,
    torch,
    with_precision,
)

from kfvo_ros.backbones.base import LOST_VARIANCE, Estimate, Status, Window, WindowPrior
from kfvo_ros.backbones.vggt import camera_head
from kfvo_ros.backbones.vggt.backbone import VggtBackbone, load_backbone
from kfvo_ros.backbones.vggt.preprocessing import fit_image
from kfvo_ros.errors import KfvoError
from kfvo_ros.images import to_grey
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.odometry.scale import ScaleAligner, compare_translations
from kfvo_ros.odometry.window_prior import scale_poses

FRAMES = noise_frames(14)


@pytest.fixture(scope='module')
def backbone() -> VggtBackbone:
    return VggtBackbone(small_model(), WIDTH)


@pytest.fixture(scope='module')
def windows(backbone) -> list[Window]:
    """Windows of landscape and portrait images."""
    return [make_window(backbone, frames) for frames in (
        FRAMES[:8], FRAMES[5:7], noise_frames(5, seed=1, height=90, width=60))]


def make_broken_backbone(**changes: float) -> VggtBackbone:
    """Return a backbone with constant parameters in its camera head, by name."""
    model = copy.deepcopy(small_model())
    for name, value in changes.items():
        model.camera_head.get_parameter(name.replace('__', '.')).fill_(value)
    return VggtBackbone(model, WIDTH)


def test_descriptor_is_the_cls_token(backbone):
    encoded = backbone.open(None).encode(FRAMES[0])
    assert encoded.stamp_ns == FRAMES[0].stamp_ns
    assert encoded.tracks is None
    assert encoded.descriptor.shape == (backbone.descriptor_size,) == (128,)
    assert encoded.descriptor.dtype == np.float32
    image = to_tensor(fit_image(60, 80, WIDTH).apply(FRAMES[0].image)[None])
    with torch.inference_mode():
        cls = small_model().aggregator.encode_images(image)[0, 0].numpy()
    assert np.array_equal(encoded.descriptor, cls)
    assert not np.allclose(cls, backbone.open(None).encode(FRAMES[1]).descriptor, atol=1e-2)


def test_grey_images_equal_repeated_channels(backbone):
    assert not backbone.needs_camera
    grey = [replace(frame, image=to_grey(frame.image)) for frame in FRAMES[:3]]
    colour = [replace(frame, image=frame.image[..., None].repeat(3, axis=2)) for frame in grey]
    one, other = (backbone.estimate([make_window(backbone, frames)])[0]
                  for frames in (grey, colour))
    assert np.array_equal(one.T_anchor_frame, other.T_anchor_frame)
    mixed = backbone.estimate([make_window(backbone, FRAMES[:3])])[0]
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
    """The first camera is the model's world only approximately, so its extrinsics count too."""
    encodings = backbone.pose_encodings(windows[:1])[-1, 0]
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
        assert len(np.unique(covariance[1:, 0, 0])) == len(covariance) - 1  # depends on the data


def test_estimate_has_no_side_effects(backbone, windows):
    first, again = (backbone.estimate(windows)[0] for _ in range(2))
    assert np.array_equal(first.T_anchor_frame, again.T_anchor_frame)


@pytest.mark.parametrize('with_prior', [False, True])
def test_poses_of_nan_are_lost(with_prior):
    backbone = make_broken_backbone(pose_branch__fc2__bias=float('nan'))
    window = make_window(backbone, FRAMES[:4])
    known = np.tile(np.eye(4), (3, 1, 1))
    known[:, 0, 3] = np.arange(3)
    if with_prior:
        window = replace(window, prior=WindowPrior(known, known[2], None))
    estimate, = backbone.estimate([window])
    assert estimate.status is Status.LOST
    expected = [*known, known[2]] if with_prior else [np.eye(4)] * 4
    assert np.array_equal(estimate.T_anchor_frame, expected)
    assert np.array_equal(estimate.covariance[1:], [LOST_VARIANCE * np.eye(6)] * 3)


def test_a_quaternion_of_length_zero_is_lost():
    backbone = make_broken_backbone(pose_branch__fc2__weight=0.0, pose_branch__fc2__bias=0.0)
    estimate, = backbone.estimate([make_window(backbone, FRAMES[:3])])
    assert estimate.status is Status.LOST
    assert np.isfinite(estimate.T_anchor_frame).all() and np.isfinite(estimate.covariance).all()


def test_the_odometry_survives_a_model_of_nan():
    backbone = make_broken_backbone(trunk_norm__weight=float('nan'))
    odometry = KeyframeOdometry(backbone, ScriptedPolicy(True))
    updates = [odometry.process(frame) for frame in FRAMES]
    assert {update.status for update in updates[1:]} == {Status.LOST}
    assert all(np.isfinite(update.T_world_camera).all() for update in updates)


def test_black_images_are_lost(backbone):
    black = replace(FRAMES[1], image=np.zeros_like(FRAMES[1].image))
    odometry = KeyframeOdometry(backbone, ScriptedPolicy(True))
    updates = [odometry.process(frame) for frame in (black, FRAMES[0], black, FRAMES[2])]
    assert [update.status for update in updates] == [Status.LOST, Status.OK] * 2
    assert [update.is_keyframe for update in updates] == [False, True] * 2


@pytest.mark.parametrize(('height', 'width'), [(60, 80), (90, 60), (37, 122)])
def test_intrinsics_are_those_of_the_native_image(height, width, backbone):
    """A ray has corresponding pixels in the fitted and the native image."""
    frames = noise_frames(3, seed=1, height=height, width=width)
    window = make_window(backbone, frames)
    fit = fit_image(height, width, WIDTH)
    assert (fit.first_row > 0) == (height > width)
    encodings = backbone.pose_encodings([window])[-1, 0, -1]
    K_fitted = camera_head.decode_intrinsics(encodings, fit.rows, WIDTH)
    K = backbone.estimate([window])[0].intrinsics
    ray = np.array([0.02, -0.03, 1.0])
    u, v, _ = K_fitted @ ray
    np.testing.assert_allclose(
        K @ ray, [u * width / WIDTH, (v + fit.first_row) * height / fit.height, 1.0])
    np.testing.assert_allclose(K[:2, 2], [width / 2, height / 2], atol=height / fit.height)
    assert K[0, 1] == K[1, 0] == 0.0


def test_all_images_of_a_stream_have_one_size(backbone):
    stream = backbone.open(None)
    stream.encode(FRAMES[0])
    with pytest.raises(KfvoError, match='80x60 as before, 60x90 came'):
        stream.encode(noise_frames(1, height=90, width=60)[0])
    stream.encode(FRAMES[1])  # the stream continues
    backbone.open(None).encode(noise_frames(1, height=90, width=60)[0])


def test_released_frames_hold_nothing(backbone):
    window = make_window(backbone, FRAMES[:2])
    backbone.estimate([window])
    payload = window.frames[0].payload
    assert any(isinstance(each, torch.Tensor) for each in vars(payload).values())
    window.stream.release(window.frames[0])
    assert not any(isinstance(each, torch.Tensor | tuple) for name, each in vars(payload).items()
                   if name not in ('fit', 'grid'))
    window.stream.release(window.frames[0])  # a second release has no effect


# float16: half precision with the smaller range of exponents


@pytest.mark.parametrize('reuse', [True, False])
@pytest.mark.parametrize('size', [2, 8])
def test_float16_is_near(size, reuse, small_vggt):
    """The largest difference measured on a CPU is 1.6e-3; bfloat16's is up to ten times that."""
    half, exact = (load_backbone(str(small_vggt), None, 'cpu', precision, WIDTH, reuse, size)
                   for precision in ('fp16', 'fp32'))
    assert half.device_info()['precision'] == 'float16'
    for seed in range(2):
        frames = noise_frames(size, seed)
        found, expected = (each.estimate([make_window(each, frames)])[0] for each in (half, exact))
        assert found.status is Status.OK
        assert np.isfinite(found.T_anchor_frame).all() and np.isfinite(found.covariance).all()
        assert 1e-5 < np.abs(found.T_anchor_frame - expected.T_anchor_frame).max() < 5e-3
        np.testing.assert_allclose(found.intrinsics, expected.intrinsics, rtol=3e-3)


@pytest.mark.parametrize(('dtype', 'status'), [
    (torch.float32, Status.OK), (torch.bfloat16, Status.OK), (torch.float16, Status.LOST)])
def test_overflow_of_float16_is_lost(dtype, status):
    model = with_precision(small_model(), dtype)
    model.aggregator.patch_embed.blocks[0].norm2.weight.mul_(1e6)  # float16 ends at 65504
    backbone = VggtBackbone(model, WIDTH)
    estimate, = backbone.estimate([make_window(backbone, FRAMES[:3])])
    assert estimate.status is status
    assert np.isfinite(estimate.T_anchor_frame).all()


# In the odometry


class RecordingAligner(ScaleAligner):
    """Records its arguments and results."""

    def __init__(self, rule: str) -> None:
        super().__init__(rule)
        self.calls: list[tuple[Estimate, WindowPrior | None, float]] = []

    def align(self, estimate: Estimate, prior: WindowPrior | None) -> float:
        """Return the scale, and record the call."""
        self.calls.append((estimate, prior, super().align(estimate, prior)))
        return self.calls[-1][2]

    def ratios(self) -> list[float | None]:
        """Return the ratio of prior to aligned translations of each window with a prior.

        None where the random model's poses contradict the prior, as after a new anchor.
        """
        return [compare_translations(prior.T_anchor_frame,
                                     scale_poses(estimate.T_anchor_frame, scale))
                for estimate, prior, scale in self.calls if prior is not None]


def run_aligned(rule: str | None, backbone: VggtBackbone) -> RecordingAligner:
    """Return the aligner of an odometry that keeps every other frame."""
    odometry = KeyframeOdometry(backbone, ScriptedPolicy(*[True, False] * 4), rule)
    odometry.scale = RecordingAligner(odometry.scale.rule)
    for frame in FRAMES:
        odometry.process(frame)
    return odometry.scale


def test_windows_are_aligned_to_one_scale(backbone):
    aligner = run_aligned(None, backbone)
    assert aligner.rule == backbone.default_scale_rule == 'translation'
    with_prior = [prior is not None for _, prior, _ in aligner.calls]
    assert with_prior == [False] + [True] * (len(FRAMES) - 2)  # from the third frame on
    scales, ratios = [scale for _, _, scale in aligner.calls], aligner.ratios()
    known = [ratio for ratio in ratios if ratio is not None]
    assert len(known) >= 8
    np.testing.assert_allclose(known, 1.0, rtol=1e-6)
    for before, scale, ratio in zip(scales[:-1], scales[1:], ratios, strict=True):
        assert ratio is not None or scale == before


def test_scale_rule_none_keeps_the_models_scale(backbone):
    aligner = run_aligned('none', backbone)
    assert {scale for _, _, scale in aligner.calls} == {1.0}
    known = [ratio for ratio in aligner.ratios() if ratio is not None]
    assert np.abs(np.log(known)).max() > 0.01  # alignment would have an effect
