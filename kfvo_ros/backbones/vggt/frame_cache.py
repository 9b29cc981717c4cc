# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Per-frame tensors of a sliding window, and features of windows with and without their reuse."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kfvo_ros.backbones.vggt.aggregator import (
    Aggregator,
    FrameRole,
    GlobalAttentionInput,
    PatchGrid,
)
from kfvo_ros.backbones.vggt.preprocessing import ImageFit

CachedFrames = Sequence['FrameCache']


class FrameCache:
    """Tensors of one frame: ``image`` (3, H, W) in [0, 1] and patch tokens (1, h w, width).

    ``fit`` maps back to the native size, ``grid`` is (h, w). The input of global attention is
    cached for the latest role only: a frame that became the anchor stays the anchor.
    """

    def __init__(self, fit: ImageFit, grid: PatchGrid, image: Tensor, patches: Tensor) -> None:
        self.fit, self.grid = fit, grid
        self.image: Tensor | None = image
        self.patches: Tensor | None = patches
        self._input: tuple[FrameRole, GlobalAttentionInput] | None = None

    def global_attention_input(self, aggregator: Aggregator, role: FrameRole
                               ) -> GlobalAttentionInput:
        """Return the input of this frame in `role`, computed where the role is new."""
        if self._input is None or self._input[0] is not role:
            assert self.patches is not None, 'the frame was released'
            self._input = role, aggregator.global_attention_input(self.patches, self.grid, role)
        return self._input[1]

    def release(self) -> None:
        """Free the tensors."""
        self.image = self.patches = self._input = None


def aggregate_images(aggregator: Aggregator, windows: Sequence[CachedFrames]) -> Tensor:
    """Return features (B, S, 2 width) of windows from their images, as published."""
    images = [frame.image for window in windows for frame in window if frame.image is not None]
    return aggregator(torch.stack(images).unflatten(0, (len(windows), -1)))


def aggregate_cached(aggregator: Aggregator, windows: Sequence[CachedFrames]) -> Tensor:
    """Return the same features from the cached tensors of each frame."""
    inputs = [frame.global_attention_input(
                  aggregator, FrameRole.OTHER if index else FrameRole.ANCHOR)
              for window in windows for index, frame in enumerate(window)]
    first = GlobalAttentionInput(*(torch.cat(parts).unflatten(0, (len(windows), -1))
                                   for parts in zip(*inputs)))
    return aggregator.aggregate(first, windows[0][0].grid)
