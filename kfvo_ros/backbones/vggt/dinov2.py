# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The DINOv2 vision transformer with registers: what each frame looks like, on its own."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from kfvo_ros.backbones.vggt.config import HEAD_SIZE, PATCH, REGISTERS, VggtConfig
from kfvo_ros.backbones.vggt.layers import Block, LayerNorm

EPS = 1e-6
"""Of the trunk's norms; all others have 1e-5."""


class PatchEmbedding(nn.Module):
    """Cuts images into patches and maps each to a token."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, PATCH, PATCH)

    def forward(self, images: Tensor) -> Tensor:
        """Return tokens (N, h w, width), row by row, of images (N, 3, H, W)."""
        return self.proj(images.to(self.proj.weight.dtype)).flatten(2).transpose(1, 2)


class DinoV2(nn.Module):
    """Images to tokens, frame by frame."""

    def __init__(self, config: VggtConfig) -> None:
        super().__init__()
        width = config.width
        self.grid = config.grid
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.grid ** 2, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, REGISTERS, width))
        # In every checkpoint, used only where patches are hidden in training.
        self.mask_token = nn.Parameter(torch.zeros(1, width))
        self.patch_embed = PatchEmbedding(width)
        self.blocks = nn.ModuleList(Block(width, width // HEAD_SIZE, EPS)
                                    for _ in range(config.trunk_depth))
        self.norm = LayerNorm(width, eps=EPS)

    def forward(self, images: Tensor) -> Tensor:
        """Return tokens (N, SPECIAL + h w, width) of normalised images (N, 3, H, W).

        The first is CLS, then the registers, then the patches row by row.
        """
        count, _, height, width = images.shape
        patches = self.patch_embed(images) + self.places(height // PATCH, width // PATCH)
        cls = (self.cls_token + self.pos_embed[:, :1]).expand(count, -1, -1)
        # The registers come in after the places were added: they have none.
        x = torch.cat([cls, self.register_tokens.expand(count, -1, -1), patches], dim=1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)

    def places(self, rows: int, columns: int) -> Tensor:
        """Return the embedding (1, rows columns, width) of patch positions."""
        table = self.pos_embed[:, 1:]
        if rows == columns == self.grid:
            return table
        table = table.unflatten(1, (self.grid, self.grid)).permute(0, 3, 1, 2)
        # The filter that low-passes, not torch's plain one: its cubic has another coefficient.
        table = functional.interpolate(table, (rows, columns), mode='bicubic', antialias=True)
        return table.flatten(2).transpose(1, 2)
