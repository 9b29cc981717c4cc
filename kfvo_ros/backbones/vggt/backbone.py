# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT against the contract: encode what is a frame's own, estimate what a window means."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Backbone, Encoded, Estimate, Stream, Window, lost
from kfvo_ros.backbones.vggt import camera_head
from kfvo_ros.backbones.vggt.aggregator import grid_of
from kfvo_ros.backbones.vggt.checkpoint import load_model, locate_weights
from kfvo_ros.backbones.vggt.config import PATCH, SPECIAL
from kfvo_ros.backbones.vggt.frame_cache import FrameCache, features_cached, features_recomputed
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.backbones.vggt.preprocessing import Fit, fit
from kfvo_ros.backbones.vggt.runtime import (
    DeviceTime,
    choose_device,
    choose_dtype,
    compile_blocks,
    compiler_needed,
    memory_bounded,
    use_onednn_layout,
)
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Frame

IMAGE_WIDTH = 518
"""Of the images that the published model was trained on [px]."""
TRANSLATION_DOUBT, ROTATION_DOUBT = 0.02, 0.005
"""Standard deviations at least: a share of the distance to the anchor, and radians."""
LEAST_DOUBT = 1e-3
"""Nor is a translation known better than this share of the window's extent."""
Item = TypeVar('Item')
Result = TypeVar('Result')
WARM_UP_SHAPE = (480, 640, 3)
"""Most cameras' aspect ratio."""


class VggtStream(Stream):
    """Frames of one sequence, all of one size."""

    def __init__(self, backbone: VggtBackbone) -> None:
        self._backbone = backbone
        self._fit: Fit | None = None

    def encode(self, frame: Frame) -> Encoded:
        """See the frame on its own; the descriptor is the trunk's CLS token."""
        return self._backbone.encode([(self, frame)])[0]

    def fit_of(self, frame: Frame) -> Fit:
        """Return how the frame is fitted; raises KfvoError for another size than before."""
        height, width = frame.image.shape[:2]
        if self._fit is None:
            self._fit = fit(height, width, self._backbone.image_width)
        expected = self._fit
        if (height, width) != (expected.native_height, expected.native_width):
            raise KfvoError(f'expected images of {expected.native_width}x{expected.native_height} '
                            f'as before, {width}x{height} came')
        return expected

    def release(self, encoded: Encoded) -> None:
        """Free the frame's tensors."""
        encoded.payload.release()


class VggtBackbone(Backbone):
    """Takes images as they come, of any camera; poses are right up to one scale per window.

    `image_width` [px], a multiple of 14, trades accuracy for time. Without `reuse` every window
    is computed in full. Raises KfvoError for what cannot be, and when memory runs out.
    """

    name = 'vggt'
    needs_camera = False

    def __init__(self, model: Vggt, image_width: int = IMAGE_WIDTH, reuse: bool = True) -> None:
        if image_width < PATCH or image_width % PATCH:
            raise KfvoError(f'expected image_width as a multiple of {PATCH}, came {image_width}')
        self.model = model
        self.image_width, self.reuse = image_width, reuse
        self.descriptor_size = model.config.width
        self.device = model.camera_head.empty_pose_tokens.device

    def open(self, camera: Camera | None) -> VggtStream:
        """Start a sequence; the camera need not be known."""
        return VggtStream(self)

    def encode(self, seen: Sequence[tuple[Stream, Frame]]) -> list[Encoded]:
        """See many frames, each on its own; those alike in fitted size go in one batch."""
        fitted = [(frame, _stream_of(stream).fit_of(frame)) for stream, frame in seen]
        return _in_batches(fitted, lambda each: (each[1].rows, each[1].width), self._see)

    def estimate(self, windows: Sequence[Window]) -> list[Estimate]:
        """Place the frames of many windows; those alike in frames and size go in one batch."""
        return _in_batches(windows, lambda window: (
            len(window.frames), window.frames[0].payload.grid), self._place)

    def encodings(self, windows: Sequence[Window]) -> np.ndarray:
        """Return pose encodings (iterations, B, S, 9) of windows of one size."""
        return self._infer(windows)[0]

    def condition(self) -> dict[str, str]:
        """Return device, numbers and what the device's memory holds."""
        matrices = self.model.aggregator.patch_embed.patch_embed.proj.weight
        told = {'device': str(self.device), 'precision': str(matrices.dtype).rpartition('.')[2]}
        if self.device.type == 'cuda':
            held = torch.cuda.memory_allocated(self.device) / 1024.0 ** 2
            told |= {'device': f'{self.device} {torch.cuda.get_device_name(self.device)}',
                     'device memory [MiB]': f'{held:.0f}'}
        return told

    def _see(self, frames: Sequence[tuple[Frame, Fit]]) -> list[Encoded]:
        """Encode frames of one fitted size."""
        with torch.inference_mode(), memory_bounded(self.device):
            pixels = np.stack([fitted.apply(frame.image) for frame, fitted in frames])
            images = torch.tensor(pixels, device=self.device).permute(0, 3, 1, 2) / 255.0
            tokens = self.model.aggregator.see(images)
            descriptors = tokens[:, 0].float().cpu().numpy()
            # Copied: a view would keep the whole batch alive.
            return [Encoded(frame.stamp_ns, descriptor.copy(), FrameCache(
                        fitted, grid_of(images), image.clone(), patches[None].clone()))
                    for (frame, fitted), descriptor, image, patches in zip(
                        frames, descriptors, images, tokens[:, SPECIAL:])]

    def _place(self, windows: Sequence[Window]) -> list[Estimate]:
        """Estimate windows of one size."""
        encodings, head_s = self._infer(windows)
        return [replace(_estimate(window, encodings[:, index]),
                        durations={'head': head_s / len(windows)})
                for index, window in enumerate(windows)]

    def _infer(self, windows: Sequence[Window]) -> tuple[np.ndarray, float]:
        """Return the encodings of windows of one size, and how long the head took [s]."""
        frames = [[encoded.payload for encoded in window.frames] for window in windows]
        features = features_cached if self.reuse else features_recomputed
        with torch.inference_mode(), memory_bounded(self.device):
            seen = features(self.model.aggregator, frames)
            with DeviceTime(self.device) as head:
                encodings = self.model.camera_head(seen)
            return encodings.cpu().numpy(), head.seconds


def _stream_of(stream: Stream) -> VggtStream:
    if not isinstance(stream, VggtStream):
        raise TypeError(f'expected a VggtStream, came {type(stream)}')
    return stream


def _in_batches(items: Sequence[Item], kind: Callable[[Item], Hashable],
                batch: Callable[[list[Item]], list[Result]]) -> list[Result]:
    """Return what `batch` makes of the items, in their order; it is given one kind at a time."""
    alike: dict[Hashable, list[int]] = {}
    for index, item in enumerate(items):
        alike.setdefault(kind(item), []).append(index)
    results: dict[int, Result] = {}
    for indices in alike.values():
        results.update(zip(indices, batch([items[index] for index in indices])))
    return [results[index] for index in range(len(items))]


def _estimate(window: Window, encodings: np.ndarray) -> Estimate:
    """Turn the encodings (iterations, S, 9) of one window into poses in its anchor."""
    with np.errstate(invalid='ignore', divide='ignore'):
        before, T_camera_world = camera_head.decode_transforms(encodings[-2:])
    if not np.isfinite(T_camera_world).all():
        return lost(window)
    # The first frame is only nearly the model's world.
    T_anchor_frame = T_camera_world[0] @ geometry.invert(T_camera_world)
    T_anchor_frame[0] = np.eye(4)
    fitted = window.frames[-1].payload.fit
    K = camera_head.decode_intrinsics(encodings[-1], fitted.rows, fitted.width)
    return Estimate(T_anchor_frame, partial(_covariance, before[0] @ geometry.invert(before),
                                            T_anchor_frame),
                    points=None, signals=np.zeros(0, dtype=np.float32),
                    intrinsics=fitted.native(K[-1]))


def _covariance(before: np.ndarray, T_anchor_frame: np.ndarray) -> np.ndarray:
    """Doubt what the last refinement still changed, and a share of how far a frame is away.

    The model tells no confidence of its poses. `before` and `T_anchor_frame` are the poses
    (S, 4, 4) of the last two iterations; returns (S, 6, 6).
    """
    positions = T_anchor_frame[:, :3, 3]
    distances = np.linalg.norm(positions, axis=1)
    moved = np.linalg.norm(positions - before[:, :3, 3], axis=1)
    turned = geometry.rotation_angle(geometry.relative(before, T_anchor_frame)[:, :3, :3])
    translation = np.maximum(moved, TRANSLATION_DOUBT * distances + LEAST_DOUBT * distances.max())
    rotation = np.maximum(turned, ROTATION_DOUBT)
    deviations = np.repeat(np.column_stack([translation, rotation]), 3, axis=1)
    deviations[0] = 0.0
    return deviations[:, :, None] ** 2 * np.eye(6)


def load_backbone(weights: str, revision: str | None, device: str, precision: str,
                  image_width: int, reuse: bool, window_size: int,
                  compiled: bool = False) -> VggtBackbone:
    """Return the backbone with its weights on the device; raises KfvoError.

    On a GPU, or `compiled`, it has placed windows before it is returned: kernels are made, loaded
    and tuned then, and no frame waits for them.
    """
    place = choose_device(device)
    dtype = choose_dtype(precision, place)
    path = locate_weights(weights, revision)
    with memory_bounded(place):
        model = load_model(path, place, dtype)
        if compiled:
            compile_blocks(model)
        elif place.type == 'cpu':
            use_onednn_layout(model)
    logging.getLogger(__name__).info('%s on %s, matrices in %s', path, place, dtype)
    backbone = VggtBackbone(model, image_width, reuse)
    if compiled:
        with compiler_needed():
            warm_up(backbone, window_size)
    elif place.type == 'cuda':
        warm_up(backbone, window_size)
    return backbone


def warm_up(backbone: VggtBackbone, window_size: int) -> None:
    """Place windows of every size up to `window_size`, as they come at the start."""
    stream = backbone.open(None)
    frame = Frame(0, np.zeros(WARM_UP_SHAPE, dtype=np.uint8), None)
    frames = tuple(stream.encode(frame) for _ in range(window_size))
    for size in range(2, window_size + 1):
        backbone.estimate([Window(stream, frames[:size])])
