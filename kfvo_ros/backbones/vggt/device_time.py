# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How long a device is busy with a part of its work, told without making anybody wait."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any

import torch


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
