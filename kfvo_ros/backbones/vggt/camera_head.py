# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT's camera head, and its pose encoding as transforms and intrinsics.

A pose encoding has nine numbers: t (3), quat_xyzw (4), fov_h, fov_w [rad]. The pose is
T_camera_world of optical frames; the quaternion need not have unit length. As in the model, the
height's field of view comes before the width's.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from kfvo_ros import geometry
from kfvo_ros.backbones.vggt.config import CAMERA_ATTENTION_HEADS, VggtConfig
from kfvo_ros.backbones.vggt.layers import Block, LayerNorm, Linear, Mlp

ITERATIONS = 4
POSE_ENCODING_SIZE = 9
MODULATION_EPS = 1e-6


class CameraHead(nn.Module):
    """Iterative refinement of the poses of all frames, by attention between the frames."""

    def __init__(self, config: VggtConfig) -> None:
        super().__init__()
        width = 2 * config.width
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, POSE_ENCODING_SIZE))
        self.trunk = nn.ModuleList(Block(width, CAMERA_ATTENTION_HEADS)
                                   for _ in range(config.camera_depth))
        self.token_norm = LayerNorm(width)
        self.trunk_norm = LayerNorm(width)
        self.embed_pose = Linear(POSE_ENCODING_SIZE, width)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), Linear(width, 3 * width))
        self.pose_branch = Mlp(width, width // 2, POSE_ENCODING_SIZE)

    def forward(self, features: Tensor) -> Tensor:
        """Return pose encodings (ITERATIONS, B, S, 9) of features (B, S, 2 width)."""
        tokens = self.token_norm(features)
        normalised = functional.layer_norm(tokens, tokens.shape[-1:], eps=MODULATION_EPS)
        pose, encodings = None, []
        for _ in range(ITERATIONS):
            condition = self.empty_pose_tokens if pose is None else pose
            shift, scale, gate = self.poseLN_modulation(self.embed_pose(condition)).chunk(
                3, dim=-1)
            x = gate * (normalised * (1 + scale) + shift) + tokens
            for block in self.trunk:
                x = block(x)
            update = self.pose_branch(self.trunk_norm(x))
            # The next iteration continues from the pose with unclipped fields of view.
            pose = update if pose is None else pose + update
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
