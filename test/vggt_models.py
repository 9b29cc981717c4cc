# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT models of known weights, made by recipe; what imports this skips where torch is missing.

The recipe, and the arrays in data/vggt that the official model gave with it, are described in
the data's origin: every tensor comes from a generator seeded by the CRC-32 of its own name.
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
from kfvo_ros.backbones.vggt.config import VggtConfig, config_of  # noqa: E402
from kfvo_ros.backbones.vggt.model import Vggt  # noqa: E402
from kfvo_ros.backbones.vggt.runtime import set_precision  # noqa: E402
from kfvo_ros.sequences.base import Frame  # noqa: E402

DATA = Path(__file__).with_name('data') / 'vggt'
SMALL = VggtConfig(width=128, trunk_depth=2, depth=3, camera_depth=1, grid=7)
"""Every kind of layer there is, and no more of them than that takes."""
WIDTH = 70
"""Image width for a small model [px]; images of 4:3 have 4 rows of 5 patches then."""
COMPILER = os.environ.get('CXX') or 'g++'
needs_compiler = pytest.mark.skipif(
    shutil.which(COMPILER) is None,
    reason=f'torch compiles for processors with {COMPILER}, which is not installed')
TOKENS = ('cls_token', 'register_tokens', 'mask_token', 'pos_embed', 'camera_token',
          'register_token', 'empty_pose_tokens')


def weight(key: str, shape: Sequence[int]) -> np.ndarray:
    """Return the tensor of this name, float32, by the recipe."""
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


def model_of(shapes: dict[str, tuple[int, ...]]) -> Vggt:
    """Return the model of these tensors, by the recipe."""
    with torch.device('meta'):
        model = Vggt(config_of(shapes))
    tensors = {key: torch.from_numpy(weight(key, shape)) for key, shape in shapes.items()}
    model.load_state_dict(tensors, assign=True)
    return model.eval().requires_grad_(False)


@cache
def small_model() -> Vggt:
    """Return a model of SMALL sizes; not to be changed."""
    with torch.device('meta'):
        like = Vggt(SMALL)
    return model_of({key: tuple(each.shape) for key, each in like.state_dict().items()})


def saved_small(path: Path) -> Path:
    """Write the small model to a .safetensors file."""
    save_file(dict(small_model().state_dict()), path)
    return path


def changed(model: Vggt, dtype: torch.dtype) -> Vggt:
    """Return a copy with its matrices in `dtype`."""
    return set_precision(copy.deepcopy(model), dtype)


@cache
def published_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shape of every tensor in the checkpoint of VGGT-1B."""
    keys = json.loads((DATA / 'manifest_1b.json').read_text())['keys']
    return {key: tuple(shape) for key, shape in keys}


def images_of(seed: int, count: int, height: int, width: int) -> np.ndarray:
    """Return images (S, H, W, 3) of a camera that moves over noise of three grains."""
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
def frames_seen(count: int, seed: int = 0, height: int = 60, width: int = 80
                ) -> tuple[Frame, ...]:
    """Return frames of no known camera; the same objects at every call."""
    return tuple(Frame(1 + 50_000_000 * index, image, None)
                 for index, image in enumerate(images_of(seed, count, height, width)))


def to_tensor(images: np.ndarray) -> Tensor:
    """Return (S, 3, H, W) in [0, 1] of images (S, H, W, 3) uint8."""
    return torch.tensor(images).permute(0, 3, 1, 2).float() / 255.0


def window_of(backbone: VggtBackbone, frames: Sequence[Frame]) -> Window:
    """Return the window of these frames in a new stream."""
    stream = backbone.open(None)
    return Window(stream, tuple(stream.encode(frame) for frame in frames))


@contextmanager
def listening(**modules: nn.Module) -> Iterator[dict[str, list[tuple[Tensor, Tensor]]]]:
    """Give what goes into and comes out of some modules, by name, in order."""
    heard: dict[str, list[tuple[Tensor, Tensor]]] = {name: [] for name in modules}

    def listener(name: str) -> Any:
        return lambda module, given, came: heard[name].append((given[0], came))

    hooks = [module.register_forward_hook(listener(name)) for name, module in modules.items()]
    try:
        yield heard
    finally:
        for hook in hooks:
            hook.remove()
