# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The sizes of a VGGT model; the published one and small ones for tests differ in nothing else."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from kfvo_ros.errors import KfvoError

PATCH = 14
"""Side of a square patch [px]."""
REGISTERS = 4
"""Register tokens of a frame, in the trunk and in the aggregator alike."""
SPECIAL = 1 + REGISTERS
"""Tokens of a frame before its patches: the camera token (CLS in the trunk) and the registers."""
HEAD_SIZE = 64
"""Channels of one attention head of trunk and aggregator."""
CAMERA_HEADS = 16
"""Attention heads of the camera head, whatever its width."""
WIDTHS = range(HEAD_SIZE, 8192 + 1, HEAD_SIZE)
"""What a file may ask for; VGGT-1B has 1024."""


@dataclass(frozen=True)
class VggtConfig:
    """Sizes of a model; the defaults are those of VGGT-1B.

    ``width`` channels of a token, ``trunk_depth`` blocks of the DINOv2 trunk, ``depth`` pairs of
    frame and global blocks, ``camera_depth`` blocks of the camera head, ``grid`` side of the
    table of patch positions, which is resized to the grid of the image.
    """

    width: int = 1024
    trunk_depth: int = 24
    depth: int = 24
    camera_depth: int = 4
    grid: int = 37


def config_of(shapes: Mapping[str, tuple[int, ...]]) -> VggtConfig:
    """Read the sizes off the keys and shapes of a checkpoint; raises KfvoError if it is none."""
    try:
        width = shapes['aggregator.camera_token'][3]
        positions = shapes['aggregator.patch_embed.pos_embed'][1]
    except (KeyError, IndexError) as error:
        known = ', '.join(sorted(shapes)[:3]) or 'nothing'
        raise KfvoError('expected the weights of a VGGT model, with aggregator.camera_token and '
                        f'aggregator.patch_embed.pos_embed; the file holds {known} ...') from error
    config = VggtConfig(
        width=width, trunk_depth=_blocks(shapes, 'aggregator.patch_embed.blocks'),
        depth=_blocks(shapes, 'aggregator.frame_blocks'),
        camera_depth=_blocks(shapes, 'camera_head.trunk'),
        grid=math.isqrt(max(positions - 1, 0)))
    if width not in WIDTHS or config.depth < 2 or config.grid < 1:
        raise KfvoError(
            f'expected a VGGT model of a width that {HEAD_SIZE} divides, up to {WIDTHS[-1]}, of '
            f'at least two layers and one position; width {width}, {config.depth} layers and '
            f'{positions} rows of positions came')
    return config


def _blocks(shapes: Mapping[str, tuple[int, ...]], prefix: str) -> int:
    """Count the blocks of a stack; a number in a file may be of any size."""
    numbers = {found[1] for key in shapes
               if (found := re.match(rf'{re.escape(prefix)}\.(\d+)\.', key))}
    return len(numbers)
