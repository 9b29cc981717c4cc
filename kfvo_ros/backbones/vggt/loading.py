# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From what a user chose to a backbone that is ready for its first frame."""

from __future__ import annotations

import logging

import numpy as np

from kfvo_ros.backbones.base import Window
from kfvo_ros.backbones.vggt.backbone import VggtBackbone
from kfvo_ros.backbones.vggt.checkpoint import load_model
from kfvo_ros.backbones.vggt.compiling import compile_blocks, compiler_needed
from kfvo_ros.backbones.vggt.out_of_memory import memory_bounded
from kfvo_ros.backbones.vggt.packing import pack
from kfvo_ros.backbones.vggt.precision import choose_device, choose_dtype
from kfvo_ros.backbones.vggt.weights import locate
from kfvo_ros.sequences.base import Frame

WARM_UP_SHAPE = (480, 640, 3)
"""Most cameras' aspect ratio."""


def load_backbone(weights: str, revision: str | None, device: str, precision: str,
                  image_width: int, reuse: bool, window_size: int,
                  compiled: bool = False) -> VggtBackbone:
    """Return the backbone with its weights on the device; raises KfvoError.

    On a GPU, or `compiled`, it has placed windows before it is returned: kernels are made, loaded
    and tuned then, and no frame waits for them.
    """
    place = choose_device(device)
    dtype = choose_dtype(precision, place)
    path = locate(weights, revision)
    with memory_bounded(place):
        model = load_model(path, place, dtype)
        if compiled:
            compile_blocks(model)
        elif place.type == 'cpu':
            pack(model)
    logging.getLogger(__name__).info('%s on %s, matrices in %s', path, place, dtype)
    backbone = VggtBackbone(model, image_width, reuse)
    if compiled:
        with compiler_needed():
            warm_up(backbone, window_size)
    elif place.type == 'cuda':
        warm_up(backbone, window_size)
    return backbone


def warm_up(backbone: VggtBackbone, window_size: int) -> None:
    """Place windows of every size up to `window_size`, as they come at the start."""
    stream = backbone.open(None)
    frame = Frame(0, np.zeros(WARM_UP_SHAPE, dtype=np.uint8), None)
    frames = tuple(stream.encode(frame) for _ in range(window_size))
    for size in range(2, window_size + 1):
        backbone.estimate([Window(stream, frames[:size])])
