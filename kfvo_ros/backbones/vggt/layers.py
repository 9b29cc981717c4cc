# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rotary position embedding in two dimensions: a token's place turns its queries and keys.

The first half of a head's channels is turned by the row, the second by the column; within a
half, channel j is paired with channel j + a quarter of the head ("rotate half").
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from kfvo_ros.backbones.vggt.config import HEAD_SIZE, SPECIAL

ROPE_BASE = 100.0
"""Wave lengths rise geometrically from 2 pi patches towards BASE times that."""
QueriesKeysValues = tuple[Tensor, Tensor, Tensor]
"""Each (B, N, heads, channels)."""


class Rope(NamedTuple):
    """Cosine and sine (N, 1, HEAD_SIZE) of the angles of N tokens, the sine with its sign."""

    cos: Tensor
    sin: Tensor

    def turn(self, x: Tensor) -> Tensor:
        """Turn queries or keys x (..., N, heads, HEAD_SIZE)."""
        partner = x.unflatten(-1, (2, 2, -1)).flip(-2).flatten(-3)
        return torch.addcmul(x * self.cos, partner, self.sin)

    def repeat(self, frames: int) -> Rope:
        """Return the table of several frames one after the other: they share their places."""
        return Rope(self.cos.repeat(frames, 1, 1), self.sin.repeat(frames, 1, 1))


def make_rope(rows: int, columns: int, like: Tensor) -> Rope:
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
    angles = places[:, :, None] * ROPE_BASE ** -exponents
    cos, sin = angles.cos(), angles.sin()
    return Rope(torch.stack([cos, cos], dim=2).flatten(1)[:, None],
                torch.stack([-sin, sin], dim=2).flatten(1)[:, None])


class Linear(nn.Linear):
    """x (..., in) to (..., out)."""

    def forward(self, x: Tensor) -> Tensor:
        """Multiply in the type of the weights."""
        return functional.linear(x.to(self.weight.dtype), self.weight, self.bias)

    def rows(self, x: Tensor, first: int, last: int | None) -> Tensor:
        """Return only some of the outputs."""
        weight, bias = self.weight[first:last], self.bias[first:last]
        return functional.linear(x.to(weight.dtype), weight, bias)


class LayerNorm(nn.LayerNorm):
    """Normalises the last dimension."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalise in the type of the weights."""
        return super().forward(x.to(self.weight.dtype))


class LayerScale(nn.Module):
    """One factor per channel on what a branch adds to the residual stream."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        """Scale x (..., width)."""
        return x * self.gamma


class Mlp(nn.Module):
    """Two linear layers around an exact GELU."""

    def __init__(self, width: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = Linear(width, hidden)
        self.fc2 = Linear(hidden, out)

    def forward(self, x: Tensor) -> Tensor:
        """Map x (..., width) to (..., out)."""
        return self.fc2(functional.gelu(self.fc1(x)))


class Attention(nn.Module):
    """Multi-head attention, with queries and keys normalised per head where `qk_norm`."""

    def __init__(self, width: int, heads: int, qk_norm: bool) -> None:
        super().__init__()
        self.heads, self.channels = heads, width // heads
        self.qkv = Linear(width, 3 * width)
        self.q_norm = LayerNorm(self.channels) if qk_norm else nn.Identity()
        self.k_norm = LayerNorm(self.channels) if qk_norm else nn.Identity()
        self.proj = Linear(width, width)

    def project(self, x: Tensor, rotary: Rope | None) -> QueriesKeysValues:
        """Return what tokens x (B, N, width) ask, answer to, and tell."""
        q, k, v = self._split(self.qkv(x))
        q, k = self.q_norm(q), self.k_norm(k)
        if rotary is not None:
            q, k = rotary.turn(q), rotary.turn(k)
        return q.to(v.dtype), k.to(v.dtype), v

    def project_special(self, special: Tensor, x: Tensor, rotary: Rope) -> QueriesKeysValues:
        """Return the same, but ask only for special tokens (B, M, width), which are not turned."""
        width = x.shape[-1]
        (q,) = self._split(self.qkv.rows(special, 0, width))
        k, v = self._split(self.qkv.rows(x, width, None))
        return self.q_norm(q).to(v.dtype), rotary.turn(self.k_norm(k)).to(v.dtype), v

    def forward(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Return the answers to the queries, (B, N, width)."""
        answers = functional.scaled_dot_product_attention(
            q.transpose(1, 2), k.transpose(1, 2), v.transpose(1, 2))
        return self.proj(answers.transpose(1, 2).flatten(2))

    def _split(self, x: Tensor) -> tuple[Tensor, ...]:
        """Cut (B, N, parts x width) into parts (B, N, heads, channels)."""
        return x.unflatten(-1, (-1, self.heads, self.channels)).unbind(2)


class Block(nn.Module):
    """Attention and MLP, each normalised before and scaled after, on a residual stream.

    `forward` is two steps, `project` and `complete`: a window that slides knows the outcome of
    the first one already for most of its frames.
    """

    def __init__(self, width: int, heads: int, eps: float = 1e-5, qk_norm: bool = False) -> None:
        super().__init__()
        self.norm1 = LayerNorm(width, eps=eps)
        self.attn = Attention(width, heads, qk_norm)
        self.ls1 = LayerScale(width)
        self.norm2 = LayerNorm(width, eps=eps)
        self.mlp = Mlp(width, 4 * width, width)
        self.ls2 = LayerScale(width)

    def forward(self, x: Tensor, rotary: Rope | None = None) -> Tensor:
        """Return tokens (B, N, width) after the block."""
        return self.complete(x, *self.project(x, rotary))

    def project(self, x: Tensor, rotary: Rope | None = None) -> QueriesKeysValues:
        """Return queries, keys and values of tokens x (B, N, width)."""
        return self.attn.project(self.norm1(x), rotary)

    def complete(self, x: Tensor, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Return tokens x (B, N, width) after attention and MLP; k and v may be of more."""
        x = x + self.ls1(self.attn(q, k, v))
        return x + self.ls2(self.mlp(self.norm2(x)))

    def special(self, special: Tensor, x: Tensor, rotary: Rope) -> Tensor:
        """Return only special tokens (B, M, width) out of tokens x (B, N, width)."""
        return self.complete(special, *self.attn.project_special(
            self.norm1(special), self.norm1(x), rotary))
