# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the model runs, and in which numbers."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

from kfvo_ros.backbones.vggt.layers import Linear
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.errors import KfvoError

PRECISIONS = {'fp32': torch.float32, 'bf16': torch.bfloat16, 'fp16': torch.float16}
BFLOAT16_FLAGS = ('avx512_bf16', 'amx_bf16', 'bf16')
"""What Linux calls bfloat16 arithmetic on x86-64 (two kinds) and on ARM."""
AMPERE = (8, 0)
"""The first compute capability with bfloat16."""


def choose_device(name: str) -> torch.device:
    """Return the device for ``auto``, ``cpu``, ``cuda`` or ``cuda:N``; raises KfvoError."""
    if name == 'auto':
        return torch.device('cuda:0' if torch.cuda.is_available() else 'cpu')
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device('meta')
    if device.type == 'cpu':
        return device
    if device.type != 'cuda':
        raise KfvoError(f'expected the device auto, cpu, cuda or cuda:N, came {name!r}')
    index, count = device.index or 0, torch.cuda.device_count()
    if index >= count:
        raise KfvoError(f'the device {name} was asked for, and torch {torch.__version__} sees '
                        f'{count} CUDA devices: set device to cpu or auto')
    return torch.device('cuda', index)


def choose_dtype(precision: str, device: torch.device) -> torch.dtype:
    """Return the type of the aggregator's matrices; ``auto`` is what the device does fast."""
    if precision != 'auto':
        return PRECISIONS[precision]
    if device.type == 'cuda':
        modern = torch.cuda.get_device_capability(device) >= AMPERE
        return torch.bfloat16 if modern else torch.float16
    return torch.bfloat16 if _cpu_has_bfloat16() else torch.float32


def set_precision(model: Vggt, dtype: torch.dtype) -> Vggt:
    """Store the aggregator's matrices in `dtype` and return the model.

    Norms, scales, tokens, the table of places and the whole camera head stay as they are: see
    `layers` for what follows from that.
    """
    for module in model.aggregator.modules():
        if isinstance(module, Linear | nn.Conv2d):
            module.to(dtype)
    return model


def _cpu_has_bfloat16() -> bool:
    about = Path('/proc/cpuinfo')
    words = set(about.read_text(encoding='utf-8').split()) if about.exists() else set()
    return any(flag in words for flag in BFLOAT16_FLAGS)
