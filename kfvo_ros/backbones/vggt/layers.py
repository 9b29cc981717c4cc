# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transformer block that trunk, aggregator and camera head are stacks of.

Every layer computes in the type of its own weights and casts what it is given. So the types in
which weights are stored are the whole precision policy: with matrices in bfloat16, norms and
scales in float32, the residual stream stays in float32 too, because the scales promote it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from kfvo_ros.backbones.vggt.rotary import Rotary

QueriesKeysValues = tuple[Tensor, Tensor, Tensor]
"""Each (B, N, heads, channels)."""


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

    def project(self, x: Tensor, rotary: Rotary | None) -> QueriesKeysValues:
        """Return what tokens x (B, N, width) ask, answer to, and tell."""
        q, k, v = self._split(self.qkv(x))
        q, k = self.q_norm(q), self.k_norm(k)
        if rotary is not None:
            q, k = rotary.turn(q), rotary.turn(k)
        return q.to(v.dtype), k.to(v.dtype), v

    def project_special(self, special: Tensor, x: Tensor, rotary: Rotary) -> QueriesKeysValues:
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

    def forward(self, x: Tensor, rotary: Rotary | None = None) -> Tensor:
        """Return tokens (B, N, width) after the block."""
        return self.complete(x, *self.project(x, rotary))

    def project(self, x: Tensor, rotary: Rotary | None = None) -> QueriesKeysValues:
        """Return queries, keys and values of tokens x (B, N, width)."""
        return self.attn.project(self.norm1(x), rotary)

    def complete(self, x: Tensor, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Return tokens x (B, N, width) after attention and MLP; k and v may be of more."""
        x = x + self.ls1(self.attn(q, k, v))
        return x + self.ls2(self.mlp(self.norm2(x)))

    def special(self, special: Tensor, x: Tensor, rotary: Rotary) -> Tensor:
        """Return only special tokens (B, M, width) out of tokens x (B, N, width)."""
        return self.complete(special, *self.attn.project_special(
            self.norm1(special), self.norm1(x), rotary))
