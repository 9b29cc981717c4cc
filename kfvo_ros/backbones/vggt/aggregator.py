# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Alternating attention, within each frame and over all frames: what the frames mean together.

`forward` is the model as published. `see`, `first_layer` and `relate` are the same model in the
steps of a sliding window: what depends on one frame alone is computed once per frame, and of
the last layer only what the camera head reads. Both ways give the same numbers.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from kfvo_ros.backbones.vggt.config import HEAD_SIZE, PATCH, REGISTERS, SPECIAL, VggtConfig
from kfvo_ros.backbones.vggt.dinov2 import DinoV2
from kfvo_ros.backbones.vggt.layers import Block, make_rope

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet, per channel; not in any checkpoint."""
Grid = tuple[int, int]
"""Rows and columns of an image's patches."""


class Role(IntEnum):
    """A frame's part in its window: all that tells the anchor from the others."""

    ANCHOR = 0
    OTHER = 1


class FirstLayer(NamedTuple):
    """The part of the first pair of blocks that knows one frame and its role only.

    ``tokens`` (..., P, width) after the frame block; ``q``, ``k``, ``v`` (..., P, heads,
    HEAD_SIZE) of the global block. Behind it nothing is a frame's own any more.
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
        self.camera_token = nn.Parameter(torch.zeros(1, len(Role), 1, width))
        self.register_token = nn.Parameter(torch.zeros(1, len(Role), REGISTERS, width))
        self.patch_embed = DinoV2(config)
        self.frame_blocks, self.global_blocks = (
            nn.ModuleList(Block(width, width // HEAD_SIZE, qk_norm=True)
                          for _ in range(config.depth)) for _ in range(2))

    def forward(self, images: Tensor) -> Tensor:
        """Return features (B, S, 2 width) of images (B, S, 3, H, W) in [0, 1]."""
        batch, frames = images.shape[:2]
        grid = grid_of(images)
        patches = self.see(images.flatten(0, 1))[:, SPECIAL:]
        roles = [Role.ANCHOR] + [Role.OTHER] * (frames - 1)
        special = self._special()[roles].repeat(batch, 1, 1)
        within = make_rope(*grid, like=self.camera_token)
        across = within.repeat(frames)
        x = torch.cat([special, patches], dim=1)
        for frame_block, global_block in self._layers():
            seen = frame_block(x, within)
            x = global_block(seen.view(batch, -1, seen.shape[-1]), across).view_as(seen)
        return torch.cat([seen[:, 0], x[:, 0]], dim=-1).unflatten(0, (batch, frames))

    def see(self, images: Tensor) -> Tensor:
        """Return the trunk's tokens (N, SPECIAL + h w, width) of images (N, 3, H, W)."""
        mean, std = (images.new_tensor(each).view(3, 1, 1) for each in (MEAN, STD))
        return self.patch_embed((images - mean) / std)

    def first_layer(self, patches: Tensor, grid: Grid, role: Role) -> FirstLayer:
        """Return what the first layer makes of patches (N, h w, width) of frames in one role."""
        rotary = make_rope(*grid, like=self.camera_token)
        special = self._special()[role].expand(len(patches), -1, -1)
        frame_block, global_block = self._layers()[0]
        tokens = frame_block(torch.cat([special, patches], dim=1), rotary)
        q, k, v = global_block.project(tokens, rotary)
        return FirstLayer(tokens, q, k, v.clone())  # a view would keep all three alive

    def relate(self, first: FirstLayer, grid: Grid) -> Tensor:
        """Return features (B, S, 2 width) of windows, given their first layer (B, S, ...)."""
        batch, frames, _, width = first.tokens.shape
        within = make_rope(*grid, like=self.camera_token)
        across = within.repeat(frames)
        (_, first_global), *between, (last_frame, last_global) = self._layers()
        x = first_global.complete(*(part.flatten(1, 2) for part in first))
        for frame_block, global_block in between:
            x = frame_block(x.view(batch * frames, -1, width), within)
            x = global_block(x.view(batch, -1, width), across)
        x = last_frame(x.view(batch * frames, -1, width), within)
        camera = x[:, 0].view(batch, frames, width)
        told = last_global.special(camera, x.view(batch, -1, width), across)
        return torch.cat([camera, told], dim=-1)

    def _layers(self) -> list[tuple[Block, Block]]:
        """Return the pairs of frame block and global block."""
        return cast(list[tuple[Block, Block]],
                    list(zip(self.frame_blocks, self.global_blocks, strict=True)))

    def _special(self) -> Tensor:
        """Return the special tokens (roles, SPECIAL, width)."""
        return torch.cat([self.camera_token, self.register_token], dim=2)[0]


def grid_of(images: Tensor) -> Grid:
    """Return the patches of images (..., H, W)."""
    return images.shape[-2] // PATCH, images.shape[-1] // PATCH
