# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is kept of one frame while it is in a window, so that it is computed only once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kfvo_ros.backbones.vggt.aggregator import Aggregator, FirstLayer, Grid, Role
from kfvo_ros.backbones.vggt.preprocessing import Fit

Frames = Sequence['FrameCache']


class FrameCache:
    """One frame: its ``image`` (3, H, W) in [0, 1], its trunk's ``patches`` (1, h w, width).

    ``fit`` leads back to its native size, ``grid`` is (h, w). The first layer is kept for the
    frame's latest role: an anchor was something else before, and will not be again.
    """

    def __init__(self, fit: Fit, grid: Grid, image: Tensor, patches: Tensor) -> None:
        self.fit, self.grid = fit, grid
        self.image: Tensor | None = image
        self.patches: Tensor | None = patches
        self._layer: tuple[Role, FirstLayer] | None = None

    def first_layer(self, aggregator: Aggregator, role: Role) -> FirstLayer:
        """Return the first layer of this frame in `role`, computed when it is new there."""
        if self._layer is None or self._layer[0] is not role:
            assert self.patches is not None, 'the frame was released'
            self._layer = role, aggregator.first_layer(self.patches, self.grid, role)
        return self._layer[1]

    def release(self) -> None:
        """Free the tensors."""
        self.image = self.patches = self._layer = None


def features_recomputed(aggregator: Aggregator, windows: Sequence[Frames]) -> Tensor:
    """Return features (B, S, 2 width) of windows, with nothing reused: the model as published."""
    images = [frame.image for window in windows for frame in window if frame.image is not None]
    return aggregator(torch.stack(images).unflatten(0, (len(windows), -1)))


def features_cached(aggregator: Aggregator, windows: Sequence[Frames]) -> Tensor:
    """Return the same, from what is known of each frame."""
    layers = [frame.first_layer(aggregator, Role.OTHER if index else Role.ANCHOR)
              for window in windows for index, frame in enumerate(window)]
    first = FirstLayer(*(torch.cat(parts).unflatten(0, (len(windows), -1))
                         for parts in zip(*layers)))
    return aggregator.relate(first, windows[0][0].grid)
