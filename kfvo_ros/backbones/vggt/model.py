# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT without its heads for depth, points and tracks: 1.125 of 1.257 billion parameters."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kfvo_ros.backbones.vggt.aggregator import Aggregator
from kfvo_ros.backbones.vggt.camera_head import CameraHead
from kfvo_ros.backbones.vggt.config import VggtConfig
from kfvo_ros.backbones.vggt.layers import LayerNorm, LayerScale, Linear


class Vggt(nn.Module):
    """Visual geometry grounded transformer: images of a window to poses and fields of view.

    Parameters have the names of the published checkpoints. Source: Wang et al., VGGT: Visual
    Geometry Grounded Transformer, CVPR 2025.
    """

    def __init__(self, config: VggtConfig | None = None) -> None:
        super().__init__()
        self.config = config or VggtConfig()
        self.aggregator = Aggregator(self.config)
        self.camera_head = CameraHead(self.config)

    def forward(self, images: Tensor) -> Tensor:
        """Return pose encodings (iterations, B, S, 9) of images (B, S, 3, H, W) in [0, 1]."""
        return self.camera_head(self.aggregator(images))


def set_precision(model: Vggt, dtype: torch.dtype) -> Vggt:
    """Store the aggregator's matrices in `dtype` and return the model.

    Norms, scales, tokens, position embedding and the whole camera head keep theirs: see `layers`
    for the consequences.
    """
    for module in model.aggregator.modules():
        if isinstance(module, Linear | nn.Conv2d):
            module.to(dtype)
    return model


def random_model(device: torch.device, dtype: torch.dtype,
                 config: VggtConfig | None = None) -> Vggt:
    """Return a model of random weights, created on `device` without a second copy."""
    with torch.device('meta'):
        model = set_precision(Vggt(config), dtype)
    model = model.to_empty(device=device)
    for module in model.modules():
        for name, parameter in module.named_parameters(recurse=False):
            if isinstance(module, LayerNorm | LayerScale) and name != 'bias':
                nn.init.constant_(parameter, 1.0 if isinstance(module, LayerNorm) else 0.1)
            else:
                nn.init.normal_(parameter, std=0.02)
    return model.eval().requires_grad_(False)
