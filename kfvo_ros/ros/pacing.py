# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bag time against the clock on the wall."""

from __future__ import annotations

import time
from collections.abc import Callable

from kfvo_ros.trajectory import NANOSECONDS


class Pacing:
    """Lets bag time pass at a rate; what is late is not waited for, and delays nothing after it.

    `tick` is called with the bag time [ns], `frequency` times a second, during the waits.
    """

    def __init__(self, rate: float, tick: Callable[[int], None] | None = None,
                 frequency: float = 1.0) -> None:
        self._rate, self._tick = rate, tick
        self._period_ns = round(NANOSECONDS / frequency)
        self.begin(0)

    def begin(self, bag_time_ns: int) -> None:
        """Let it be `bag_time_ns` now."""
        self._from_ns = bag_time_ns
        self._began_ns = self._next_tick_ns = time.monotonic_ns()

    def wait_for(self, bag_time_ns: int) -> int:
        """Sleep until it is `bag_time_ns`; return how late it is by then [ns]."""
        due_ns = self._began_ns + round((bag_time_ns - self._from_ns) / self._rate)
        while True:
            now_ns = time.monotonic_ns()
            wake_ns = due_ns
            if self._tick is not None:
                if now_ns >= self._next_tick_ns:
                    self._tick(self._from_ns + round((now_ns - self._began_ns) * self._rate))
                    missed = (now_ns - self._next_tick_ns) // self._period_ns
                    self._next_tick_ns += (missed + 1) * self._period_ns
                wake_ns = min(due_ns, self._next_tick_ns)
            if now_ns >= due_ns:
                return now_ns - due_ns
            time.sleep(max(wake_ns - now_ns, 0) / NANOSECONDS)
