# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fetch what comes next while what came before is used."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Generic, TypeVar

Item = TypeVar('Item')


class ReadAhead(Generic[Item]):
    """Iterates over `items` in their order, a thread fetching them until `limit` is reached.

    `size_of` tells how much of `limit` an item takes; one more than fits is held. An error of
    `items` is raised after the items before it. Leaving ``with`` ends the thread.
    """

    def __init__(self, items: Iterator[Item], size_of: Callable[[Item], int], limit: int) -> None:
        self._items, self._size_of, self._limit = items, size_of, limit
        self._fetched: deque[Item] = deque()
        self._size = 0
        self._ended = self._unwanted = False
        self._error: BaseException | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._fetch, name='read_ahead', daemon=True)

    def __enter__(self) -> ReadAhead[Item]:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        with self._changed:
            self._unwanted = True
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
                    if self._unwanted:
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
        return self._unwanted or self._size < self._limit
