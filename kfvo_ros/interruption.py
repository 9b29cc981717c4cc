# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM: as one exception, held back, collected or ignored."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """SIGINT or SIGTERM came.

    A KeyboardInterrupt itself, once it has passed through an `exec` (as dataclasses use), makes
    Python end by SIGINT at last, caught or not.
    """


def raise_on_signals(even_ignored: bool) -> None:
    """Let either signal raise Interrupted in the main thread.

    A signal that this process was started to ignore, as shells start what a script puts in the
    background, does so only if `even_ignored`.
    """
    for number in SIGNALS:
        if even_ignored or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)


def ignore_signals() -> None:
    """Let nothing disturb the clean-up: another Ctrl-C would end it in a traceback."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def signals_held() -> Iterator[None]:
    """Hold signals back: rclpy tells of one during its import as of a broken installation."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


@contextmanager
def signals_collected() -> Iterator[list[int]]:
    """Give a list that grows by each signal, which raises nothing and cuts nothing in two."""
    received: list[int] = []
    previous = {number: signal.signal(number, lambda number, _: received.append(number))
                for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: Any) -> None:
    raise Interrupted
