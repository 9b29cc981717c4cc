# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The VGGT backbone: frames are encoded one by one, poses are estimated per window."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Backbone, Encoded, Estimate, Stream, Window, lost_estimate
from kfvo_ros.backbones.vggt import camera_head
from kfvo_ros.backbones.vggt.aggregator import patch_grid
from kfvo_ros.backbones.vggt.checkpoint import load_model, locate_weights
from kfvo_ros.backbones.vggt.config import NUM_PREFIX_TOKENS, PATCH_SIZE
from kfvo_ros.backbones.vggt.frame_cache import FrameCache, aggregate_cached, aggregate_images
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.backbones.vggt.preprocessing import ImageFit, fit_image
from kfvo_ros.backbones.vggt.runtime import (
    DeviceTimer,
    choose_device,
    choose_dtype,
    compile_blocks,
    compile_errors,
    memory_errors,
    use_onednn_layout,
)
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.images import to_grey
from kfvo_ros.sequences.base import Frame
from kfvo_ros.tracking.blindness import is_flat

IMAGE_WIDTH = 518
"""Width of the images that the published model was trained on [px]."""
MIN_TRANSLATION_UNCERTAINTY = 0.02
"""Smallest standard deviation of a position, as a share of its distance to the anchor."""
MIN_EXTENT_UNCERTAINTY = 1e-3
"""Added to it: a share of the window's extent."""
MIN_ROTATION_UNCERTAINTY = 0.005
"""Smallest standard deviation of a rotation [rad]."""
WARM_UP_SHAPE = (480, 640, 3)
"""The aspect ratio of most cameras."""
Item = TypeVar('Item')
Result = TypeVar('Result')


class VggtStream(Stream):
    """Frames of one sequence, all of one size."""

    def __init__(self, backbone: VggtBackbone) -> None:
        self._backbone = backbone
        self._fit: ImageFit | None = None

    def encode(self, frame: Frame) -> Encoded:
        """Encode the frame; the descriptor is DINOv2's CLS token."""
        return self._backbone.encode([(self, frame)])[0]

    def image_fit(self, frame: Frame) -> ImageFit:
        """Return the fit of the frame's image; raises KfvoError for another size than before."""
        height, width = frame.image.shape[:2]
        if self._fit is None:
            self._fit = fit_image(height, width, self._backbone.image_width)
        expected = self._fit
        if (height, width) != (expected.native_height, expected.native_width):
            raise KfvoError(f'expected images of {expected.native_width}x{expected.native_height} '
                            f'as before, {width}x{height} came')
        return expected

    def release(self, encoded: Encoded) -> None:
        """Free the frame's tensors."""
        encoded.payload.release()


class VggtBackbone(Backbone):
    """VGGT for images of any camera; the scale of each window is arbitrary.

    `image_width` [px], a multiple of 14, trades accuracy for time. Without `reuse` every window
    is computed in full. Raises KfvoError for an invalid width and when memory is full.
    """

    name = 'vggt'
    needs_camera = False

    def __init__(self, model: Vggt, image_width: int = IMAGE_WIDTH, reuse: bool = True) -> None:
        if image_width < PATCH_SIZE or image_width % PATCH_SIZE:
            raise KfvoError(f'expected image_width as a multiple of {PATCH_SIZE}, came '
                            f'{image_width}')
        self.model = model
        self.image_width, self.reuse = image_width, reuse
        self.descriptor_size = model.config.width
        self.device = model.camera_head.empty_pose_tokens.device

    def open(self, camera: Camera | None) -> VggtStream:
        """Start a sequence; the camera is not used."""
        return VggtStream(self)

    def encode(self, batch: Sequence[tuple[Stream, Frame]]) -> list[Encoded]:
        """Encode frames of many streams; frames of equal fitted size form one batch."""
        fitted = [(frame, _vggt_stream(stream).image_fit(frame)) for stream, frame in batch]
        return _map_batches(self._encode_batch, fitted,
                            key=lambda each: (each[1].rows, each[1].width))

    def estimate(self, windows: Sequence[Window]) -> list[Estimate]:
        """Estimate many windows; windows of equal length and image size form one batch."""
        return _map_batches(self._estimate_batch, windows, key=lambda window: (
            len(window.frames), window.frames[0].payload.grid))

    def pose_encodings(self, windows: Sequence[Window]) -> np.ndarray:
        """Return pose encodings (iterations, B, S, 9) of windows of one size."""
        return self._infer(windows)[0]

    def device_info(self) -> dict[str, str]:
        """Return device, precision, and on a GPU the memory in use."""
        weight = self.model.aggregator.patch_embed.patch_embed.proj.weight
        info = {'device': str(self.device), 'precision': str(weight.dtype).rpartition('.')[2]}
        if self.device.type == 'cuda':
            used_mb = torch.cuda.memory_allocated(self.device) / 1024.0 ** 2
            info |= {'device': f'{self.device} {torch.cuda.get_device_name(self.device)}',
                     'device memory [MiB]': f'{used_mb:.0f}'}
        return info

    def _encode_batch(self, frames: Sequence[tuple[Frame, ImageFit]]) -> list[Encoded]:
        """Encode frames of one fitted size."""
        with torch.inference_mode(), memory_errors(self.device):
            pixels = np.stack([fit.apply(frame.image) for frame, fit in frames])
            images = torch.tensor(pixels, device=self.device).permute(0, 3, 1, 2) / 255.0
            tokens = self.model.aggregator.encode_images(images)
            descriptors = tokens[:, 0].float().cpu().numpy()
            # Copied: a view would keep the whole batch alive.
            return [Encoded(frame.stamp_ns, descriptor.copy(), FrameCache(
                        fit, patch_grid(images), image.clone(), patches[None].clone()),
                        blind=is_flat(to_grey(frame.image)))
                    for (frame, fit), descriptor, image, patches in zip(
                        frames, descriptors, images, tokens[:, NUM_PREFIX_TOKENS:])]

    def _estimate_batch(self, windows: Sequence[Window]) -> list[Estimate]:
        """Estimate windows of one size."""
        encodings, head_s = self._infer(windows)
        return [replace(_decode_estimate(window, encodings[:, index]),
                        durations={'head': head_s / len(windows)})
                for index, window in enumerate(windows)]

    def _infer(self, windows: Sequence[Window]) -> tuple[np.ndarray, float]:
        """Return the pose encodings of windows of one size, and the camera head's time [s]."""
        frames = [[encoded.payload for encoded in window.frames] for window in windows]
        aggregate = aggregate_cached if self.reuse else aggregate_images
        with torch.inference_mode(), memory_errors(self.device):
            features = aggregate(self.model.aggregator, frames)
            with DeviceTimer(self.device) as head:
                encodings = self.model.camera_head(features)
            return encodings.cpu().numpy(), head.seconds


def load_backbone(weights: str, revision: str | None, device: str, precision: str,
                  image_width: int, reuse: bool, window_size: int,
                  compiled: bool = False) -> VggtBackbone:
    """Return the backbone with its weights on the device; raises KfvoError.

    `weights` and `revision` are those of `locate_weights`. On a GPU, or when `compiled`, it is
    warmed up for windows of up to `window_size` frames.
    """
    torch_device = choose_device(device)
    dtype = choose_dtype(precision, torch_device)
    path = locate_weights(weights, revision)
    with memory_errors(torch_device):
        model = load_model(path, torch_device, dtype)
        if compiled:
            compile_blocks(model)
        elif torch_device.type == 'cpu':
            use_onednn_layout(model)
    logging.getLogger(__name__).info('%s on %s, matrices in %s', path, torch_device, dtype)
    backbone = VggtBackbone(model, image_width, reuse)
    if compiled:
        with compile_errors():
            warm_up(backbone, window_size)
    elif torch_device.type == 'cuda':
        warm_up(backbone, window_size)
    return backbone


def warm_up(backbone: VggtBackbone, window_size: int) -> None:
    """Estimate windows of every size up to `window_size`, as at the start of a sequence.

    Kernels are compiled, loaded and tuned here, and not while a frame waits.
    """
    stream = backbone.open(None)
    frame = Frame(0, np.zeros(WARM_UP_SHAPE, dtype=np.uint8), None)
    frames = tuple(stream.encode(frame) for _ in range(window_size))
    for size in range(2, window_size + 1):
        backbone.estimate([Window(stream, frames[:size])])


def _vggt_stream(stream: Stream) -> VggtStream:
    if not isinstance(stream, VggtStream):
        raise TypeError(f'expected a VggtStream, came {type(stream)}')
    return stream


def _map_batches(function: Callable[[list[Item]], list[Result]], items: Sequence[Item],
                 key: Callable[[Item], Hashable]) -> list[Result]:
    """Return the results of `function` in the order of the items; a batch has one key."""
    batches: dict[Hashable, list[int]] = {}
    for index, item in enumerate(items):
        batches.setdefault(key(item), []).append(index)
    results: dict[int, Result] = {}
    for indices in batches.values():
        results.update(zip(indices, function([items[index] for index in indices])))
    return [results[index] for index in range(len(items))]


def _decode_estimate(window: Window, encodings: np.ndarray) -> Estimate:
    """Return the estimate of one window from its pose encodings (iterations, S, 9)."""
    with np.errstate(invalid='ignore', divide='ignore'):
        T_camera_world_before, T_camera_world = camera_head.decode_transforms(encodings[-2:])
    if not np.isfinite(T_camera_world).all():
        return lost_estimate(window)
    # The first camera is the model's world only approximately.
    T_anchor_frame = T_camera_world[0] @ geometry.invert(T_camera_world)
    T_anchor_frame[0] = np.eye(4)
    T_before = T_camera_world_before[0] @ geometry.invert(T_camera_world_before)
    fit = window.frames[-1].payload.fit
    K = camera_head.decode_intrinsics(encodings[-1], fit.rows, fit.width)
    return Estimate(T_anchor_frame, partial(_covariance, T_before, T_anchor_frame),
                    points=None, signals=np.zeros(0, dtype=np.float32),
                    intrinsics=fit.native_intrinsics(K[-1]))


def _covariance(T_before: np.ndarray, T_anchor_frame: np.ndarray) -> np.ndarray:
    """Return covariances (S, 6, 6) from the poses (S, 4, 4) of the last two iterations.

    The model gives no confidence of its poses. The standard deviation is the change by the last
    iteration, or a share of the distance to the anchor where that is larger.
    """
    positions = T_anchor_frame[:, :3, 3]
    distances = np.linalg.norm(positions, axis=1)
    shifts = np.linalg.norm(positions - T_before[:, :3, 3], axis=1)
    angles = geometry.rotation_angle(geometry.relative(T_before, T_anchor_frame)[:, :3, :3])
    translation = np.maximum(shifts, MIN_TRANSLATION_UNCERTAINTY * distances
                             + MIN_EXTENT_UNCERTAINTY * distances.max())
    rotation = np.maximum(angles, MIN_ROTATION_UNCERTAINTY)
    deviations = np.repeat(np.column_stack([translation, rotation]), 3, axis=1)
    deviations[0] = 0.0
    return deviations[:, :, None] ** 2 * np.eye(6)
