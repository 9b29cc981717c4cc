# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights in the layout in which a processor multiplies fastest."""

from __future__ import annotations

import logging

import torch
from torch import Tensor, nn

from kfvo_ros.backbones.vggt.layers import Block, Linear
from kfvo_ros.backbones.vggt.model import Vggt


class PackedLinear(nn.Module):
    """A Linear whose weights oneDNN has laid out for itself, as torch's own compiler does it."""

    def __init__(self, linear: Linear) -> None:
        super().__init__()
        self._dtype = linear.weight.dtype
        self._weight = torch.ops.mkldnn._reorder_linear_weight(linear.weight)
        self._bias = linear.bias

    def forward(self, x: Tensor) -> Tensor:
        """Multiply in the type of the weights."""
        return torch.ops.mkldnn._linear_pointwise(x.to(self._dtype), self._weight, self._bias,
                                                  'none', [], '')


def pack(model: Vggt) -> Vggt:
    """Lay out the matrices of a model on the CPU and return it; a matrix at a time is copied.

    Where torch has no oneDNN, or not these operators, nothing changes.
    """
    last = model.aggregator.global_blocks[-1]
    assert isinstance(last, Block)
    try:
        PackedLinear(last.attn.proj)(torch.zeros(1, model.config.width))
    except (AttributeError, RuntimeError) as error:
        logging.getLogger(__name__).info('weights are not packed: %s', error)
        return model
    # No list of the matrices themselves: it would keep every one that was laid out anew.
    for module in [each for each in model.modules() if not isinstance(each, Linear)]:
        for name, child in module.named_children():
            if isinstance(child, Linear) and child is not last.attn.qkv:  # used in parts
                setattr(module, name, PackedLinear(child))
    return model
