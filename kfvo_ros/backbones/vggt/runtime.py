# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the model runs, and in which numbers."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from kfvo_ros.backbones.vggt.layers import Block, Linear
from kfvo_ros.errors import KfvoError, MemoryFullError

if TYPE_CHECKING:
    from kfvo_ros.backbones.vggt.model import Vggt

PRECISIONS = {'fp32': torch.float32, 'bf16': torch.bfloat16, 'fp16': torch.float16}
BFLOAT16_FLAGS = ('avx512_bf16', 'amx_bf16', 'bf16')
"""What Linux calls bfloat16 arithmetic on x86-64 (two kinds) and on ARM."""
AMPERE = (8, 0)
"""The first compute capability with bfloat16."""
NO_MEMORY = ("can't allocate memory", 'could not create a')
"""What torch and its oneDNN say where the processor's memory ends; it has no type of its own."""


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


class OneDnnLinear(nn.Module):
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


def use_onednn_layout(model: Vggt) -> Vggt:
    """Lay out the matrices of a model on the CPU and return it; a matrix at a time is copied.

    Where torch has no oneDNN, or not these operators, nothing changes.
    """
    last = model.aggregator.global_blocks[-1]
    assert isinstance(last, Block)
    try:
        OneDnnLinear(last.attn.proj)(torch.zeros(1, model.config.width))
    except (AttributeError, RuntimeError) as error:
        logging.getLogger(__name__).info('weights are not packed: %s', error)
        return model
    # No list of the matrices themselves: it would keep every one that was laid out anew.
    for module in [each for each in model.modules() if not isinstance(each, Linear)]:
        for name, child in module.named_children():
            if isinstance(child, Linear) and child is not last.attn.qkv:  # used in parts
                setattr(module, name, OneDnnLinear(child))
    return model


@contextmanager
def memory_bounded(device: torch.device) -> Iterator[None]:
    """Turn an allocation that failed into a MemoryFullError with the remedies."""
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        known = isinstance(error, torch.OutOfMemoryError | MemoryError)
        if not known and not any(words in str(error) for words in NO_MEMORY):
            raise
        if device.type == 'cuda':
            torch.cuda.empty_cache()
        raise MemoryFullError(f'the memory of {device} is full: make window_size or image_width '
                              'smaller, or set precision to bf16') from error


class DeviceTime:
    """``with DeviceTime(device) as part: ...``; ``part.seconds`` once the results were fetched.

    A GPU works after the call has returned: two events go with its work instead of a wait for
    it. Asked before the device has come to the second event, torch raises RuntimeError.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device

    def __enter__(self) -> DeviceTime:
        self._begin = self._mark()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self._end = self._mark()

    @property
    def seconds(self) -> float:
        """The time [s] between begin and end."""
        if self._device.type != 'cuda':
            return self._end - self._begin
        return 1e-3 * self._begin.elapsed_time(self._end)

    def _mark(self) -> Any:
        """Return the time [s], or an event that stands for it."""
        if self._device.type != 'cuda':
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event
