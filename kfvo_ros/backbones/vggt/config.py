# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of a VGGT model: constants of the architecture, and those that a checkpoint chooses."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from kfvo_ros.errors import KfvoError

PATCH_SIZE = 14
"""Side of a square patch [px]."""
NUM_REGISTERS = 4
"""Register tokens per frame, both in DINOv2 and in the aggregator."""
NUM_PREFIX_TOKENS = 1 + NUM_REGISTERS
"""Tokens of a frame before its patches: the CLS or camera token, then the registers."""
HEAD_DIM = 64
"""Channels of one attention head in DINOv2 and in the aggregator."""
CAMERA_ATTENTION_HEADS = 16
"""Attention heads of the camera head, independent of its width."""
WIDTHS = range(HEAD_DIM, 8192 + 1, HEAD_DIM)
"""Widths accepted from a checkpoint; VGGT-1B has 1024."""


@dataclass(frozen=True)
class VggtConfig:
    """Sizes of a model; the defaults are those of VGGT-1B.

    ``width`` channels of a token, ``dinov2_depth`` blocks of DINOv2, ``depth`` pairs of frame and
    global blocks, ``camera_depth`` blocks of the camera head, ``grid`` side of the table of patch
    positions, which is interpolated to the patch grid of the image.
    """

    width: int = 1024
    dinov2_depth: int = 24
    depth: int = 24
    camera_depth: int = 4
    grid: int = 37


def config_from_shapes(shapes: Mapping[str, tuple[int, ...]]) -> VggtConfig:
    """Derive the sizes from the keys and shapes of a checkpoint.

    Raises KfvoError where they are not those of a VGGT model.
    """
    try:
        width = shapes['aggregator.camera_token'][3]
        positions = shapes['aggregator.patch_embed.pos_embed'][1]
    except (KeyError, IndexError) as error:
        found = ', '.join(sorted(shapes)[:3]) or 'nothing'
        raise KfvoError('expected the weights of a VGGT model, with aggregator.camera_token and '
                        f'aggregator.patch_embed.pos_embed; the file holds {found} ...') from error
    config = VggtConfig(
        width=width, dinov2_depth=_count_blocks(shapes, 'aggregator.patch_embed.blocks'),
        depth=_count_blocks(shapes, 'aggregator.frame_blocks'),
        camera_depth=_count_blocks(shapes, 'camera_head.trunk'),
        grid=math.isqrt(max(positions - 1, 0)))
    if width not in WIDTHS or config.depth < 2 or config.grid < 1:
        raise KfvoError(
            f'expected a VGGT model of a width that {HEAD_DIM} divides, up to {WIDTHS[-1]}, of '
            f'at least two layers and one position; width {width}, {config.depth} layers and '
            f'{positions} rows of positions came')
    return config


def _count_blocks(shapes: Mapping[str, tuple[int, ...]], prefix: str) -> int:
    """Count distinct indices: the highest index in a malformed file may be arbitrarily large."""
    indices = {found[1] for key in shapes
               if (found := re.match(rf'{re.escape(prefix)}\.(\d+)\.', key))}
    return len(indices)
