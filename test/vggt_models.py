# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT models of reproducible weights; tests that import this are skipped without torch.

Every tensor comes from a generator seeded by the CRC-32 of its own name. The arrays in data/vggt
are the official model's output with the same weights.
"""

from __future__ import annotations

import copy
import json
import math
import os
import shutil
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for _module in ('torch', 'safetensors', 'huggingface_hub', 'PIL'):
    pytest.importorskip(_module,
                        reason=f"{_module} is not installed: pip install '.[vggt]'")
import torch  # noqa: E402
from safetensors.torch import save_file  # noqa: E402
from torch import Tensor, nn  # noqa: E402

from kfvo_ros.backbones.base import Window  # noqa: E402
from kfvo_ros.backbones.vggt.backbone import VggtBackbone  # noqa: E402
from kfvo_ros.backbones.vggt.config import VggtConfig, config_from_shapes  # noqa: E402
from kfvo_ros.backbones.vggt.model import Vggt, set_precision  # noqa: E402
from kfvo_ros.sequences.base import Frame  # noqa: E402

DATA = Path(__file__).with_name('data') / 'vggt'
SMALL_CONFIG = VggtConfig(width=128, dinov2_depth=2, depth=3, camera_depth=1, grid=7)
"""The smallest model that has every kind of layer."""
WIDTH = 70
"""Image width for the small model [px]; images of 4:3 then have 4 rows of 5 patches."""
COMPILER = os.environ.get('CXX') or 'g++'
needs_compiler = pytest.mark.skipif(
    shutil.which(COMPILER) is None,
    reason=f'torch compiles for processors with {COMPILER}, which is not installed')
TOKENS = ('cls_token', 'register_tokens', 'mask_token', 'pos_embed', 'camera_token',
          'register_token', 'empty_pose_tokens')


def make_tensor(key: str, shape: Sequence[int]) -> np.ndarray:
    """Return the float32 tensor of a checkpoint key."""
    leaf, deviation, centre = key.rpartition('.')[2], 0.02, np.float32(0.0)
    if leaf == 'gamma':
        deviation, centre = 0.05, np.float32(0.5)
    elif leaf == 'weight' and len(shape) == 1:
        centre = np.float32(1.0)
    elif key == 'camera_head.pose_branch.fc2.bias':
        centre = np.array([0.0] * 6 + [0.2] * 3, dtype=np.float32)
    elif leaf in TOKENS:
        deviation = 0.5
    elif leaf == 'weight':
        deviation = 1.0 / math.sqrt(math.prod(shape[1:]))
        deviation *= 0.1 if key == 'camera_head.pose_branch.fc2.weight' else 1.0
    rng = np.random.Generator(np.random.PCG64(zlib.crc32(key.encode())))
    return rng.standard_normal(tuple(shape), dtype=np.float32) * np.float32(deviation) + centre


def make_model(shapes: dict[str, tuple[int, ...]]) -> Vggt:
    """Return the model whose checkpoint has these keys and shapes."""
    with torch.device('meta'):
        model = Vggt(config_from_shapes(shapes))
    tensors = {key: torch.from_numpy(make_tensor(key, shape)) for key, shape in shapes.items()}
    model.load_state_dict(tensors, assign=True)
    return model.eval().requires_grad_(False)


@cache
def small_model() -> Vggt:
    """Return the model of SMALL_CONFIG, shared by all tests: never modify it."""
    with torch.device('meta'):
        model = Vggt(SMALL_CONFIG)
    return make_model({key: tuple(each.shape) for key, each in model.state_dict().items()})


def save_small_model(path: Path) -> Path:
    """Write the small model to a .safetensors file."""
    save_file(dict(small_model().state_dict()), path)
    return path


def with_precision(model: Vggt, dtype: torch.dtype) -> Vggt:
    """Return a copy with its matrices in `dtype`."""
    return set_precision(copy.deepcopy(model), dtype)


@cache
def published_shapes() -> dict[str, tuple[int, ...]]:
    """Return the keys and shapes of the checkpoint of VGGT-1B."""
    keys = json.loads((DATA / 'manifest_1b.json').read_text())['keys']
    return {key: tuple(shape) for key, shape in keys}


def noise_images(seed: int, count: int, height: int, width: int) -> np.ndarray:
    """Return images (S, H, W, 3) of a camera that moves over noise of three scales."""
    rng = np.random.Generator(np.random.PCG64(seed))
    rows, columns = height + 32, width + 8 * count + 32
    canvas = np.zeros((rows, columns, 3), dtype=np.int64)
    for grain in (4, 8, 16):
        noise = rng.integers(0, 256, size=(rows // grain + 2, columns // grain + 2, 3))
        canvas += noise.repeat(grain, axis=0).repeat(grain, axis=1)[:rows, :columns]
    canvas //= 3
    return np.stack([canvas[3 * i % 32:3 * i % 32 + height, 8 * i:8 * i + width]
                     for i in range(count)]).astype(np.uint8)


@cache
def noise_frames(count: int, seed: int = 0, height: int = 60, width: int = 80
                ) -> tuple[Frame, ...]:
    """Return frames without a camera; the same objects at every call."""
    return tuple(Frame(1 + 50_000_000 * index, image, None)
                 for index, image in enumerate(noise_images(seed, count, height, width)))


def to_tensor(images: np.ndarray) -> Tensor:
    """Return (S, 3, H, W) in [0, 1] of images (S, H, W, 3) uint8."""
    return torch.tensor(images).permute(0, 3, 1, 2).float() / 255.0


def make_window(backbone: VggtBackbone, frames: Sequence[Frame]) -> Window:
    """Return the window of these frames in a new stream."""
    stream = backbone.open(None)
    return Window(stream, tuple(stream.encode(frame) for frame in frames))


@contextmanager
def record_calls(**modules: nn.Module) -> Iterator[dict[str, list[tuple[Tensor, Tensor]]]]:
    """Yield a list per name that records (first input, output) of each call of the module."""
    calls: dict[str, list[tuple[Tensor, Tensor]]] = {name: [] for name in modules}

    def recorder(name: str) -> Any:
        return lambda module, inputs, output: calls[name].append((inputs[0], output))

    hooks = [module.register_forward_hook(recorder(name)) for name, module in modules.items()]
    try:
        yield calls
    finally:
        for hook in hooks:
            hook.remove()
