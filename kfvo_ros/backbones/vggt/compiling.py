# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Blocks compiled by torch: what lies between their products becomes a few passes over memory.

Norms, rotations, casts, scales and sums compute little and read and write all tokens each time;
fused, they do so once. No CUDA graphs: the tokens that are kept from frame to frame would have to
be copied out of a graph's own memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from kfvo_ros.backbones.vggt.layers import Block
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.errors import KfvoError


def compile_blocks(model: Vggt) -> Vggt:
    """Have the blocks compiled when they are first called, and return the model.

    Blocks are alike, so a few compilations serve all of them, and sizes are symbols: other
    images and longer windows need none.
    """
    for block in model.modules():
        if isinstance(block, Block):
            block.compile(dynamic=True)
    return model


@contextmanager
def compiler_needed() -> Iterator[None]:
    """Turn what torch could not compile into a KfvoError."""
    # Not above: the compiler takes two seconds to import.
    from torch._dynamo.exc import TorchDynamoException
    try:
        yield
    except TorchDynamoException as error:
        reason = next((line for line in str(error).splitlines() if line.strip()), '')
        raise KfvoError(f'torch cannot compile the model here ({reason.strip()}): leave compile '
                        'out') from error
