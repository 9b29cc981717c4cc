# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM: raise one exception for both, or ignore, block or collect them."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """SIGINT or SIGTERM arrived.

    A plain KeyboardInterrupt that passes through an `exec` (as in dataclasses) makes Python exit
    by SIGINT, even when it is caught.
    """


def raise_on_signals(even_ignored: bool) -> None:
    """Raise Interrupted in the main thread on either signal.

    A signal that the process ignores from its start, as background jobs of shell scripts do
    SIGINT, is handled only if `even_ignored`.
    """
    for number in SIGNALS:
        if even_ignored or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)


def ignore_signals() -> None:
    """Ignore both signals: another Ctrl-C would interrupt the clean-up."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Delay both signals until the end of the block.

    rclpy reports a signal during its import as a broken installation.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


@contextmanager
def signals_collected() -> Iterator[list[int]]:
    """Yield a list to which each signal is appended instead of raising an exception."""
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
