# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Progress bars that never cost results: a closed or full stderr only hides them."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sized
from typing import Any, TypeVar

from kfvo_ros.utils.signals import raise_if_interrupted

Item = TypeVar('Item')


class ForgivingStream:
    """A text stream that drops what cannot be written to stderr."""

    def write(self, text: str) -> int:
        """Write the text, or drop it."""
        return self._try('write', text) or 0

    def flush(self) -> None:
        """Flush stderr if possible."""
        self._try('flush')

    def __getattr__(self, name: str) -> Any:  # isatty, fileno, encoding: tqdm asks for them
        return getattr(sys.stderr, name)

    def _try(self, method: str, *arguments: str) -> Any:
        try:
            return getattr(sys.stderr, method)(*arguments)
        except (AttributeError, OSError, ValueError):  # no stderr, a broken pipe, a closed file
            return None


def progress_bar(total: float | None, unit: str, description: str = '', initial: float = 0,
                 **options: Any) -> Any:
    """Return a tqdm bar on stderr; see tqdm for the options."""
    from tqdm import tqdm
    return tqdm(total=total, initial=initial, unit=unit, desc=description or None,
                file=ForgivingStream(), **options)


def progress(items: Iterable[Item], unit: str, description: str = '',
             total: float | None = None) -> Iterator[Item]:
    """Yield the items and show a bar; raise Interrupted before an item after a signal."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with progress_bar(total, unit, description) as bar:
        for item in items:
            raise_if_interrupted()
            yield item
            bar.update()
