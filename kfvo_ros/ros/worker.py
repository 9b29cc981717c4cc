# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A thread that works on the newest item, so that what comes in never waits for it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any


class Worker:
    """Calls `work` with one item after the other; the oldest of more than `size` are dropped.

    After `idle_s` without an item `idle` is called. The thread starts with `start`.
    """

    def __init__(self, work: Callable[[Any], None], idle: Callable[[], None], size: int,
                 idle_s: float = 0.5) -> None:
        self._work, self._idle, self._idle_s = work, idle, idle_s
        self._size = size
        self._items: deque[Any] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name='odometry', daemon=True)

    def start(self) -> None:
        """Begin to work."""
        self._thread.start()

    def put(self, item: Any) -> int:
        """Hand over an item; return how many older ones were dropped for it."""
        with self._changed:
            self._items.append(item)
            dropped = max(0, len(self._items) - self._size)
            for _ in range(dropped):
                self._items.popleft()
            self._changed.notify()
        return dropped

    def stop(self) -> None:
        """Let the item that is worked on be finished, drop the others, and return."""
        with self._changed:
            self._stopping = True
            self._items.clear()
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._items or self._stopping, self._idle_s)
                if self._stopping:
                    return
                item = self._items.popleft() if self._items else None
            if item is None:
                self._idle()
            else:
                self._work(item)
