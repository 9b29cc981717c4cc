# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Steps of a window with random weights and images: a model's time does not depend on them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from kfvo_ros.backbones.vggt.aggregator import grid_of
from kfvo_ros.backbones.vggt.config import SPECIAL, VggtConfig
from kfvo_ros.backbones.vggt.layers import LayerNorm, LayerScale
from kfvo_ros.backbones.vggt.memory import FrameMemory, features_reusing
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.backbones.vggt.precision import set_precision
from kfvo_ros.backbones.vggt.preprocessing import fit


class Scene:
    """A window of random frames, and the three kinds of steps with it.

    `autocast` runs the plain step as the published code does: bfloat16 arithmetic on float32
    weights, but for the camera head.
    """

    def __init__(self, model: Vggt, height: int, width: int, frames: int,
                 autocast: bool = False) -> None:
        self.model, self.autocast = model, autocast
        self.device = model.camera_head.empty_pose_tokens.device
        self.images = torch.rand(frames, 3, height, width, device=self.device)
        self._fit = fit(height, width, width)
        self._window: list[FrameMemory] = []

    def arithmetic(self) -> AbstractContextManager[object]:
        """Return the context in which a plain step multiplies matrices."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.autocast else nullcontext()

    def plain(self) -> Tensor:
        """Place the window with nothing reused."""
        with self.arithmetic():
            features = self.model.aggregator(self.images[None])
        return self.model.camera_head(features.float())

    def slide(self) -> Tensor:
        """Take in a frame and leave the oldest: another frame becomes the anchor."""
        self.fill()
        self._window = [*self._window[1:], *self._see(self.images[-1:])]
        return self._place()

    def keep_anchor(self) -> Tensor:
        """Take in a frame in place of the newest, which was dropped."""
        self.fill()
        self._window = [*self._window[:-1], *self._see(self.images[-1:])]
        return self._place()

    def fill(self) -> None:
        """Place a first window, so that every later step finds what it may reuse."""
        if not self._window:
            self._window = self._see(self.images)
            self._place()

    def _see(self, images: Tensor) -> list[FrameMemory]:
        patches = self.model.aggregator.see(images)[:, SPECIAL:]
        return [FrameMemory(self._fit, grid_of(images), image, each[None])
                for image, each in zip(images, patches)]

    def _place(self) -> Tensor:
        return self.model.camera_head(features_reusing(self.model.aggregator, [self._window]))


def random_model(device: torch.device, dtype: torch.dtype,
                 config: VggtConfig | None = None) -> Vggt:
    """Return a model of random weights, made on `device` without a second copy."""
    with torch.device('meta'):
        model = set_precision(Vggt(config), dtype)
    model = model.to_empty(device=device)
    for module in model.modules():
        for name, parameter in module.named_parameters(recurse=False):
            if isinstance(module, LayerNorm | LayerScale) and name != 'bias':
                nn.init.constant_(parameter, 1.0 if isinstance(module, LayerNorm) else 0.1)
            else:
                nn.init.normal_(parameter, std=0.02)
    return model.eval().requires_grad_(False)


def count_flops(step: Callable[[Scene], Tensor], height: int, width: int, frames: int) -> int:
    """Return the floating point operations of a step of the full model; nothing is computed."""
    with torch.device('meta'):
        scene = Scene(Vggt().requires_grad_(False), height, width, frames)
        if step is not Scene.plain:
            scene.fill()
        with FlopCounterMode(display=False) as counter:
            step(scene)
    return counter.get_total_flops()


STEPS: dict[str, Callable[[Scene], Tensor]] = {
    'plain': Scene.plain, 'sliding': Scene.slide, 'anchor kept': Scene.keep_anchor}
"""Each takes in one frame and places a window of as many frames."""
