# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transformer block of DINOv2, aggregator and camera head, and its rotary position embedding.

Every layer computes in the dtype of its own weights and casts its input. The dtypes in which
weights are stored are therefore the whole precision policy: with matrices in bfloat16 and norms
and scales in float32, the residual stream stays in float32, because the scales promote it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from kfvo_ros.backbones.vggt.config import HEAD_DIM, NUM_PREFIX_TOKENS

ROPE_BASE = 100.0
"""Wave lengths rise geometrically from 2 pi patches to ROPE_BASE times that."""
QueriesKeysValues = tuple[Tensor, Tensor, Tensor]
"""Each (B, N, heads, channels)."""


class Rope(NamedTuple):
    """Two-dimensional rotary position embedding of N tokens.

    ``cos`` and ``sin`` (N, 1, HEAD_DIM) of the rotation angles; ``sin`` carries its sign. The
    first half of a head's channels rotates with the row, the second with the column; within a
    half, channel j is paired with channel j + HEAD_DIM / 4 ("rotate half").
    """

    cos: Tensor
    sin: Tensor

    def apply(self, x: Tensor) -> Tensor:
        """Rotate queries or keys x (..., N, heads, HEAD_DIM)."""
        partner = x.unflatten(-1, (2, 2, -1)).flip(-2).flatten(-3)
        return torch.addcmul(x * self.cos, partner, self.sin)

    def repeat(self, frames: int) -> Rope:
        """Return the embedding of several frames one after the other, at equal positions."""
        return Rope(self.cos.repeat(frames, 1, 1), self.sin.repeat(frames, 1, 1))


def make_rope(rows: int, columns: int, like: Tensor) -> Rope:
    """Return the embedding of one frame's tokens, with the dtype and device of `like`.

    Prefix tokens are at (0, 0), where the rotation is the identity; patches count from 1.
    """
    row, column = torch.meshgrid(
        torch.arange(1, rows + 1, device=like.device),
        torch.arange(1, columns + 1, device=like.device), indexing='ij')
    positions = torch.stack([row.flatten(), column.flatten()], dim=1).to(like.dtype)
    positions = torch.cat([positions.new_zeros(NUM_PREFIX_TOKENS, 2), positions])
    quarter = HEAD_DIM // 4
    exponents = torch.arange(quarter, device=like.device, dtype=like.dtype) / quarter
    angles = positions[:, :, None] * ROPE_BASE ** -exponents
    cos, sin = angles.cos(), angles.sin()
    return Rope(torch.stack([cos, cos], dim=2).flatten(1)[:, None],
                torch.stack([-sin, sin], dim=2).flatten(1)[:, None])


class Linear(nn.Linear):
    """Linear layer: x (..., in) to (..., out)."""

    def forward(self, x: Tensor) -> Tensor:
        """Multiply in the dtype of the weights."""
        return functional.linear(x.to(self.weight.dtype), self.weight, self.bias)

    def forward_slice(self, x: Tensor, first: int, last: int | None) -> Tensor:
        """Return outputs [first, last) only."""
        weight, bias = self.weight[first:last], self.bias[first:last]
        return functional.linear(x.to(weight.dtype), weight, bias)


class LayerNorm(nn.LayerNorm):
    """Layer norm of the last dimension."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalise in the dtype of the weights."""
        return super().forward(x.to(self.weight.dtype))


class LayerScale(nn.Module):
    """Factor per channel of a residual branch."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        """Scale x (..., width)."""
        return x * self.gamma


class Mlp(nn.Module):
    """Two linear layers with an exact GELU in between."""

    def __init__(self, width: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = Linear(width, hidden)
        self.fc2 = Linear(hidden, out)

    def forward(self, x: Tensor) -> Tensor:
        """Map x (..., width) to (..., out)."""
        return self.fc2(functional.gelu(self.fc1(x)))


class Attention(nn.Module):
    """Multi-head attention; with `qk_norm`, queries and keys are normalised per head."""

    def __init__(self, width: int, heads: int, qk_norm: bool) -> None:
        super().__init__()
        self.heads, self.channels = heads, width // heads
        self.qkv = Linear(width, 3 * width)
        self.q_norm = LayerNorm(self.channels) if qk_norm else nn.Identity()
        self.k_norm = LayerNorm(self.channels) if qk_norm else nn.Identity()
        self.proj = Linear(width, width)

    def project(self, x: Tensor, rope: Rope | None) -> QueriesKeysValues:
        """Return queries, keys and values of tokens x (B, N, width)."""
        q, k, v = self._split(self.qkv(x))
        q, k = self.q_norm(q), self.k_norm(k)
        if rope is not None:
            q, k = rope.apply(q), rope.apply(k)
        return q.to(v.dtype), k.to(v.dtype), v

    def project_subset(self, subset: Tensor, x: Tensor, rope: Rope) -> QueriesKeysValues:
        """Return queries of a subset (B, M, width) of x, and keys and values of all of x.

        The subset holds prefix tokens, which `rope` does not rotate.
        """
        width = x.shape[-1]
        (q,) = self._split(self.qkv.forward_slice(subset, 0, width))
        k, v = self._split(self.qkv.forward_slice(x, width, None))
        return self.q_norm(q).to(v.dtype), rope.apply(self.k_norm(k)).to(v.dtype), v

    def forward(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Return the attention output of the queries, (B, N, width)."""
        output = functional.scaled_dot_product_attention(
            q.transpose(1, 2), k.transpose(1, 2), v.transpose(1, 2))
        return self.proj(output.transpose(1, 2).flatten(2))

    def _split(self, x: Tensor) -> tuple[Tensor, ...]:
        """Split (B, N, parts x width) into parts (B, N, heads, channels)."""
        return x.unflatten(-1, (-1, self.heads, self.channels)).unbind(2)


class Block(nn.Module):
    """Pre-norm attention and MLP with layer scale on a residual stream.

    `forward` is `project` followed by `complete`: a sliding window caches the outcome of the
    first step for most of its frames.
    """

    def __init__(self, width: int, heads: int, eps: float = 1e-5, qk_norm: bool = False) -> None:
        super().__init__()
        self.norm1 = LayerNorm(width, eps=eps)
        self.attn = Attention(width, heads, qk_norm)
        self.ls1 = LayerScale(width)
        self.norm2 = LayerNorm(width, eps=eps)
        self.mlp = Mlp(width, 4 * width, width)
        self.ls2 = LayerScale(width)

    def forward(self, x: Tensor, rope: Rope | None = None) -> Tensor:
        """Return tokens (B, N, width) after the block."""
        return self.complete(x, *self.project(x, rope))

    def project(self, x: Tensor, rope: Rope | None = None) -> QueriesKeysValues:
        """Return queries, keys and values of tokens x (B, N, width)."""
        return self.attn.project(self.norm1(x), rope)

    def complete(self, x: Tensor, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Return tokens x (B, N, width) after attention and MLP; k and v may have more tokens."""
        x = x + self.ls1(self.attn(q, k, v))
        return x + self.ls2(self.mlp(self.norm2(x)))

    def forward_subset(self, subset: Tensor, x: Tensor, rope: Rope) -> Tensor:
        """Return only a subset (B, M, width) of tokens x (B, N, width): prefix tokens."""
        return self.complete(subset, *self.attn.project_subset(
            self.norm1(subset), self.norm1(x), rope))
