# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The camera head: features of frames to poses, refined a few times."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from kfvo_ros import geometry
from kfvo_ros.backbones.vggt.config import CAMERA_HEADS, VggtConfig
from kfvo_ros.backbones.vggt.layers import Block, LayerNorm, Linear, Mlp

ITERATIONS = 4
POSE_SIZE = 9
"""Translation, quaternion, two fields of view: see pose_encoding."""
MODULATION_EPS = 1e-6


class CameraHead(nn.Module):
    """Frames look at each other and at the pose that the iteration before gave them."""

    def __init__(self, config: VggtConfig) -> None:
        super().__init__()
        width = 2 * config.width
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, POSE_SIZE))
        self.trunk = nn.ModuleList(Block(width, CAMERA_HEADS) for _ in range(config.camera_depth))
        self.token_norm = LayerNorm(width)
        self.trunk_norm = LayerNorm(width)
        self.embed_pose = Linear(POSE_SIZE, width)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), Linear(width, 3 * width))
        self.pose_branch = Mlp(width, width // 2, POSE_SIZE)

    def forward(self, features: Tensor) -> Tensor:
        """Return pose encodings (ITERATIONS, B, S, 9) of features (B, S, 2 width)."""
        tokens = self.token_norm(features)
        normalised = functional.layer_norm(tokens, tokens.shape[-1:], eps=MODULATION_EPS)
        pose, encodings = None, []
        for _ in range(ITERATIONS):
            given = self.empty_pose_tokens if pose is None else pose
            shift, scale, gate = self.poseLN_modulation(self.embed_pose(given)).chunk(3, dim=-1)
            x = gate * (normalised * (1 + scale) + shift) + tokens
            for block in self.trunk:
                x = block(x)
            change = self.pose_branch(self.trunk_norm(x))
            # The next iteration gets the pose as it is, not with its fields of view clipped.
            pose = change if pose is None else pose + change
            encodings.append(torch.cat([pose[..., :7], pose[..., 7:].relu()], dim=-1))
        return torch.stack(encodings)


def decode_transforms(encodings: np.ndarray) -> np.ndarray:
    """Return T_camera_world (..., 4, 4), float64, of encodings (..., 9)."""
    return geometry.transform_from_xyz_quat(np.asarray(encodings, dtype=np.float64)[..., :7])


def decode_intrinsics(encodings: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return K (..., 3, 3) of images (height, width) [px]; a field of view of 0 gives infinity."""
    fields = np.asarray(encodings, dtype=np.float64)[..., 7:]
    K = np.zeros((*fields.shape[:-1], 3, 3))
    with np.errstate(divide='ignore'):
        K[..., 0, 0] = 0.5 * width / np.tan(0.5 * fields[..., 1])
        K[..., 1, 1] = 0.5 * height / np.tan(0.5 * fields[..., 0])
    K[..., 0, 2], K[..., 1, 2], K[..., 2, 2] = 0.5 * width, 0.5 * height, 1.0
    return K
