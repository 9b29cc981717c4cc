# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Too little memory, told in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from kfvo_ros.errors import MemoryFullError

NO_MEMORY = ("can't allocate memory", 'could not create a')
"""What torch and its oneDNN say where the processor's memory ends; it has no type of its own."""


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
