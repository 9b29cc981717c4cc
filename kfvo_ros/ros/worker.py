# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two threads: a worker on a bounded queue of newest items, and a reader that reads ahead."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Generic, TypeVar

Item = TypeVar('Item')


class Worker:
    """Calls `work` with one item at a time; drops the oldest waiting items beyond `size`.

    After `idle_s` without an item it calls `idle`. The thread starts with `start`.
    """

    def __init__(self, work: Callable[[Any], None], idle: Callable[[], None], size: int,
                 idle_s: float = 0.5) -> None:
        self._work, self._idle, self._idle_s = work, idle, idle_s
        self._size = size
        self._items: deque[Any] = deque()
        self._changed = threading.Condition()
        self._stopping = self._is_busy = False
        self._thread = threading.Thread(target=self._run, name='odometry', daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def put(self, item: Any) -> int:
        """Queue an item; return the number of older ones dropped for it."""
        with self._changed:
            self._items.append(item)
            dropped = max(0, len(self._items) - self._size)
            for _ in range(dropped):
                self._items.popleft()
            self._changed.notify()
        return dropped

    @property
    def waiting(self) -> int:
        """Number of items that wait or are in work."""
        with self._changed:
            return len(self._items) + self._is_busy

    def stop(self) -> None:
        """Drop the waiting items and return once the item in work is finished."""
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
                self._is_busy = item is not None
            if item is None:
                self._idle()
            else:
                self._work(item)


class ReadAhead(Generic[Item]):
    """Iterates over `items` in order while a thread fetches them until `limit` is reached.

    `size_of` returns an item's share of `limit`; one item beyond the limit may be held. An error
    of `items` is raised after the items before it. Leaving ``with`` ends the thread.
    """

    def __init__(self, items: Iterator[Item], size_of: Callable[[Item], int], limit: int) -> None:
        self._items, self._size_of, self._limit = items, size_of, limit
        self._fetched: deque[Item] = deque()
        self._size = 0
        self._ended = self._stopping = False
        self._error: BaseException | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._fetch, name='read_ahead', daemon=True)

    def __enter__(self) -> ReadAhead[Item]:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join()

    def __iter__(self) -> Iterator[Item]:
        """Yield the items; raises what `items` raised."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._fetched or self._ended)
                if not self._fetched:
                    break
                item = self._fetched.popleft()
                self._size -= self._size_of(item)
                self._changed.notify()
            yield item
        if self._error is not None:
            raise self._error

    def _fetch(self) -> None:
        try:
            for item in self._items:
                with self._changed:
                    self._changed.wait_for(self._has_room)
                    if self._stopping:
                        break
                    self._fetched.append(item)
                    self._size += self._size_of(item)
                    self._changed.notify()
        except BaseException as error:
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify()

    def _has_room(self) -> bool:
        return self._stopping or self._size < self._limit
