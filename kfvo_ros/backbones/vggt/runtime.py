# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Execution of the model: device, dtype, compiled blocks, weight layout, memory errors, timing."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from torch import Tensor, nn

from kfvo_ros.backbones.vggt.layers import Block, Linear
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.errors import KfvoError, MemoryFullError

PRECISIONS = {'fp32': torch.float32, 'bf16': torch.bfloat16, 'fp16': torch.float16}
BFLOAT16_FLAGS = ('avx512_bf16', 'amx_bf16', 'bf16')
"""Linux's names of bfloat16 arithmetic on x86-64 (two kinds) and on ARM."""
AMPERE = (8, 0)
"""First CUDA compute capability with bfloat16."""
OUT_OF_MEMORY_MESSAGES = ("can't allocate memory", 'could not create a')
"""In the RuntimeError of torch or its oneDNN when the CPU's memory is full."""


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
    """Return the dtype of the aggregator's matrices; ``auto`` is the device's fastest."""
    if precision != 'auto':
        return PRECISIONS[precision]
    if device.type == 'cuda':
        modern = torch.cuda.get_device_capability(device) >= AMPERE
        return torch.bfloat16 if modern else torch.float16
    return torch.bfloat16 if _cpu_has_bfloat16() else torch.float32


def _cpu_has_bfloat16() -> bool:
    path = Path('/proc/cpuinfo')
    words = set(path.read_text(encoding='utf-8').split()) if path.exists() else set()
    return any(flag in words for flag in BFLOAT16_FLAGS)


def compile_blocks(model: Vggt) -> Vggt:
    """Compile the blocks at their first call; return the model.

    Compilation fuses the elementwise work between the matrix products (norms, rotations, casts,
    scales, sums), which is bound by memory. Equal blocks share a few compilations, and sizes are
    symbolic: other images and longer windows need no new one. CUDA graphs are not used: cached
    tokens would have to be copied out of a graph's own memory.
    """
    for block in model.modules():
        if isinstance(block, Block):
            block.compile(dynamic=True)
    return model


@contextmanager
def compile_errors() -> Iterator[None]:
    """Convert torch's compilation errors into a KfvoError."""
    # Imported here: the compiler takes two seconds to import.
    from torch._dynamo.exc import TorchDynamoException
    try:
        yield
    except TorchDynamoException as error:
        reason = next((line for line in str(error).splitlines() if line.strip()), '')
        raise KfvoError(f'torch cannot compile the model here ({reason.strip()}): leave compile '
                        'out') from error


class OneDnnLinear(nn.Module):
    """Linear with weights in oneDNN's own layout, by the operators of torch's compiler."""

    def __init__(self, linear: Linear) -> None:
        super().__init__()
        self._dtype = linear.weight.dtype
        self._weight = torch.ops.mkldnn._reorder_linear_weight(linear.weight)
        self._bias = linear.bias

    def forward(self, x: Tensor) -> Tensor:
        """Multiply in the dtype of the weights."""
        return torch.ops.mkldnn._linear_pointwise(x.to(self._dtype), self._weight, self._bias,
                                                  'none', [], '')


def use_onednn_layout(model: Vggt) -> Vggt:
    """Convert the matrices of a model on the CPU to oneDNN's layout, one at a time; return it.

    Without oneDNN, or these operators, in torch the model is unchanged.
    """
    last = model.aggregator.global_blocks[-1]
    assert isinstance(last, Block)
    try:
        OneDnnLinear(last.attn.proj)(torch.zeros(1, model.config.width))
    except (AttributeError, RuntimeError) as error:
        logging.getLogger(__name__).info('weights keep their layout: %s', error)
        return model
    # The list holds no matrices: it would keep the replaced ones alive.
    for module in [each for each in model.modules() if not isinstance(each, Linear)]:
        for name, child in module.named_children():
            if isinstance(child, Linear) and child is not last.attn.qkv:  # used in slices
                setattr(module, name, OneDnnLinear(child))
    return model


@contextmanager
def memory_errors(device: torch.device) -> Iterator[None]:
    """Convert failed allocations into a MemoryFullError that names the remedies."""
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        known = isinstance(error, torch.OutOfMemoryError | MemoryError)
        if not known and not any(text in str(error) for text in OUT_OF_MEMORY_MESSAGES):
            raise
        if device.type == 'cuda':
            torch.cuda.empty_cache()
        raise MemoryFullError(f'the memory of {device} is full: make window_size or image_width '
                              'smaller, or set precision to bf16') from error


class DeviceTimer:
    """Time a device takes for a block: ``with DeviceTimer(device) as timer: ...``.

    A GPU works asynchronously: two events in its queue replace a synchronisation. Read
    ``timer.seconds`` after fetching the results; torch raises RuntimeError before that.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device

    def __enter__(self) -> DeviceTimer:
        self._begin = self._mark()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self._end = self._mark()

    @property
    def seconds(self) -> float:
        """Time between begin and end [s]."""
        if self._device.type != 'cuda':
            return self._end - self._begin
        return 1e-3 * self._begin.elapsed_time(self._end)

    def _mark(self) -> Any:
        """Return the time [s], or for a GPU an event in its queue."""
        if self._device.type != 'cuda':
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event
