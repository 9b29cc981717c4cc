# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The DINOv2 vision transformer with registers: tokens of single images."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from kfvo_ros.backbones.vggt.config import HEAD_DIM, NUM_REGISTERS, PATCH_SIZE, VggtConfig
from kfvo_ros.backbones.vggt.layers import Block, LayerNorm

EPS = 1e-6
"""Epsilon of DINOv2's norms; all other norms of the model have 1e-5."""


class PatchEmbedding(nn.Module):
    """Convolution that maps each patch of an image to a token."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, PATCH_SIZE, PATCH_SIZE)

    def forward(self, images: Tensor) -> Tensor:
        """Return tokens (N, h w, width), row by row, of images (N, 3, H, W)."""
        return self.proj(images.to(self.proj.weight.dtype)).flatten(2).transpose(1, 2)


class DinoV2(nn.Module):
    """Image encoder of the model.

    Source: Oquab et al., DINOv2: Learning Robust Visual Features without Supervision, 2024;
    Darcet et al., Vision Transformers Need Registers, ICLR 2024.
    """

    def __init__(self, config: VggtConfig) -> None:
        super().__init__()
        width = config.width
        self.grid = config.grid
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.grid ** 2, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, NUM_REGISTERS, width))
        # In every checkpoint, but used only for masked patches in training.
        self.mask_token = nn.Parameter(torch.zeros(1, width))
        self.patch_embed = PatchEmbedding(width)
        self.blocks = nn.ModuleList(Block(width, width // HEAD_DIM, EPS)
                                    for _ in range(config.dinov2_depth))
        self.norm = LayerNorm(width, eps=EPS)

    def forward(self, images: Tensor) -> Tensor:
        """Return tokens (N, NUM_PREFIX_TOKENS + h w, width) of normalised images (N, 3, H, W).

        The first is CLS, then the registers, then the patches row by row.
        """
        count, _, height, width = images.shape
        positions = self.interpolate_positions(height // PATCH_SIZE, width // PATCH_SIZE)
        patches = self.patch_embed(images) + positions
        cls = (self.cls_token + self.pos_embed[:, :1]).expand(count, -1, -1)
        # Registers have no position: they join after the position embedding is added.
        x = torch.cat([cls, self.register_tokens.expand(count, -1, -1), patches], dim=1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)

    def interpolate_positions(self, rows: int, columns: int) -> Tensor:
        """Return the position embedding (1, rows columns, width) of a patch grid."""
        table = self.pos_embed[:, 1:]
        if rows == columns == self.grid:
            return table
        table = table.unflatten(1, (self.grid, self.grid)).permute(0, 3, 1, 2)
        # As published; without antialiasing torch's cubic has the coefficient -0.75, not -0.5.
        table = functional.interpolate(table, (rows, columns), mode='bicubic', antialias=True)
        return table.flatten(2).transpose(1, 2)
