# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rotary position embedding in two dimensions: a token's place turns its queries and keys.

The first half of a head's channels is turned by the row, the second by the column; within a
half, channel j is paired with channel j + a quarter of the head ("rotate half").
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kfvo_ros.backbones.vggt.config import HEAD_SIZE, SPECIAL

BASE = 100.0
"""Wave lengths rise geometrically from 2 pi patches towards BASE times that."""


class Rotary(NamedTuple):
    """Cosine and sine (N, 1, HEAD_SIZE) of the angles of N tokens, the sine with its sign."""

    cos: Tensor
    sin: Tensor

    def turn(self, x: Tensor) -> Tensor:
        """Turn queries or keys x (..., N, heads, HEAD_SIZE)."""
        partner = x.unflatten(-1, (2, 2, -1)).flip(-2).flatten(-3)
        return torch.addcmul(x * self.cos, partner, self.sin)

    def repeat(self, frames: int) -> Rotary:
        """Return the table of several frames one after the other: they share their places."""
        return Rotary(self.cos.repeat(frames, 1, 1), self.sin.repeat(frames, 1, 1))


def rotary_of(rows: int, columns: int, like: Tensor) -> Rotary:
    """Return the table of one frame's tokens, in the type and on the device of `like`.

    Special tokens come first and stand at (0, 0), which turns nothing; patches count from 1.
    """
    row, column = torch.meshgrid(
        torch.arange(1, rows + 1, device=like.device),
        torch.arange(1, columns + 1, device=like.device), indexing='ij')
    places = torch.stack([row.flatten(), column.flatten()], dim=1).to(like.dtype)
    places = torch.cat([places.new_zeros(SPECIAL, 2), places])
    quarter = HEAD_SIZE // 4
    exponents = torch.arange(quarter, device=like.device, dtype=like.dtype) / quarter
    angles = places[:, :, None] * BASE ** -exponents
    cos, sin = angles.cos(), angles.sin()
    return Rotary(torch.stack([cos, cos], dim=2).flatten(1)[:, None],
                  torch.stack([-sin, sin], dim=2).flatten(1)[:, None])
