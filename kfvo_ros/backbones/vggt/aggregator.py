# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT's aggregator: DINOv2 tokens through alternating attention, per frame and over all frames.

`Aggregator.forward` is the model as published. `encode_images`, `global_attention_input` and
`aggregate` are the same model in the steps of a sliding window: what depends on one frame alone
is computed once per frame, and the last layer computes only what the camera head reads. Both
ways give the same numbers.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from kfvo_ros.backbones.vggt.config import (
    HEAD_DIM,
    NUM_PREFIX_TOKENS,
    NUM_REGISTERS,
    PATCH_SIZE,
    VggtConfig,
)
from kfvo_ros.backbones.vggt.dinov2 import DinoV2
from kfvo_ros.backbones.vggt.layers import Block, make_rope

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's, per channel; no checkpoint holds them."""
PatchGrid = tuple[int, int]
"""Rows and columns of an image's patches."""


class FrameRole(IntEnum):
    """Role of a frame in its window; it selects the camera and register tokens."""

    ANCHOR = 0
    OTHER = 1


class GlobalAttentionInput(NamedTuple):
    """Input of the first global block's attention: the last that depends on single frames only.

    ``tokens`` (..., P, width) after the first frame block; ``q``, ``k``, ``v`` (..., P, heads,
    HEAD_DIM) of the first global block.
    """

    tokens: Tensor
    q: Tensor
    k: Tensor
    v: Tensor


class Aggregator(nn.Module):
    """Images of a window to one feature per frame, for the camera head."""

    def __init__(self, config: VggtConfig) -> None:
        super().__init__()
        width = config.width
        self.camera_token = nn.Parameter(torch.zeros(1, len(FrameRole), 1, width))
        self.register_token = nn.Parameter(torch.zeros(1, len(FrameRole), NUM_REGISTERS, width))
        self.patch_embed = DinoV2(config)
        self.frame_blocks, self.global_blocks = (
            nn.ModuleList(Block(width, width // HEAD_DIM, qk_norm=True)
                          for _ in range(config.depth)) for _ in range(2))

    def forward(self, images: Tensor) -> Tensor:
        """Return features (B, S, 2 width) of images (B, S, 3, H, W) in [0, 1]."""
        batch, frames = images.shape[:2]
        grid = patch_grid(images)
        patches = self.encode_images(images.flatten(0, 1))[:, NUM_PREFIX_TOKENS:]
        roles = [FrameRole.ANCHOR] + [FrameRole.OTHER] * (frames - 1)
        prefix = self._prefix_tokens()[roles].repeat(batch, 1, 1)
        frame_rope = make_rope(*grid, like=self.camera_token)
        global_rope = frame_rope.repeat(frames)
        x = torch.cat([prefix, patches], dim=1)
        for frame_block, global_block in self._block_pairs():
            within = frame_block(x, frame_rope)
            x = global_block(within.view(batch, -1, within.shape[-1]), global_rope).view_as(within)
        return torch.cat([within[:, 0], x[:, 0]], dim=-1).unflatten(0, (batch, frames))

    def encode_images(self, images: Tensor) -> Tensor:
        """Return DINOv2 tokens (N, NUM_PREFIX_TOKENS + h w, width) of images (N, 3, H, W)."""
        mean, std = (images.new_tensor(each).view(3, 1, 1) for each in (MEAN, STD))
        return self.patch_embed((images - mean) / std)

    def global_attention_input(self, patches: Tensor, grid: PatchGrid, role: FrameRole
                               ) -> GlobalAttentionInput:
        """Return the input for frames of one role, given their patch tokens (N, h w, width)."""
        rope = make_rope(*grid, like=self.camera_token)
        prefix = self._prefix_tokens()[role].expand(len(patches), -1, -1)
        frame_block, global_block = self._block_pairs()[0]
        tokens = frame_block(torch.cat([prefix, patches], dim=1), rope)
        q, k, v = global_block.project(tokens, rope)
        return GlobalAttentionInput(tokens, q, k, v.clone())  # a view would keep all three alive

    def aggregate(self, first: GlobalAttentionInput, grid: PatchGrid) -> Tensor:
        """Return features (B, S, 2 width) of windows of first inputs (B, S, ...)."""
        batch, frames, _, width = first.tokens.shape
        frame_rope = make_rope(*grid, like=self.camera_token)
        global_rope = frame_rope.repeat(frames)
        (_, first_global), *between, (last_frame, last_global) = self._block_pairs()
        x = first_global.complete(*(part.flatten(1, 2) for part in first))
        for frame_block, global_block in between:
            x = frame_block(x.view(batch * frames, -1, width), frame_rope)
            x = global_block(x.view(batch, -1, width), global_rope)
        x = last_frame(x.view(batch * frames, -1, width), frame_rope)
        camera = x[:, 0].view(batch, frames, width)
        return torch.cat([camera, last_global.forward_subset(
            camera, x.view(batch, -1, width), global_rope)], dim=-1)

    def _block_pairs(self) -> list[tuple[Block, Block]]:
        """Return the pairs of frame block and global block."""
        return cast(list[tuple[Block, Block]],
                    list(zip(self.frame_blocks, self.global_blocks, strict=True)))

    def _prefix_tokens(self) -> Tensor:
        """Return camera and register tokens (roles, NUM_PREFIX_TOKENS, width)."""
        return torch.cat([self.camera_token, self.register_token], dim=2)[0]


def patch_grid(images: Tensor) -> PatchGrid:
    """Return the patch grid of images (..., H, W)."""
    return images.shape[-2] // PATCH_SIZE, images.shape[-1] // PATCH_SIZE
