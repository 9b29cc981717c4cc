# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SIGINT, SIGTERM and SIGHUP: recorded by the handler, acted on where the program asks.

A handler that raises may do so inside compiled code, a destructor or between two statements that
belong together. So the handler only records the signal, and loops call `raise_if_interrupted`
or `interrupted` where they can stop.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
POLL_S = 0.05
BOUNCE_S = 0.5
"""The same signal within this time counts once: terminal and parent process may both send it."""

_received: list[tuple[int, float]] = []
_is_handling = False


class Interrupted(BaseException):
    """A signal was received; raised by `raise_if_interrupted` only, never by a handler.

    The text, which may be empty, says what was kept. No Exception, so that handlers of library
    errors let it pass; no KeyboardInterrupt, which makes Python exit by SIGINT once it passed
    through an `exec` (as in dataclasses).
    """


@contextmanager
def signals_handled(even_ignored: bool = False, until_exit: bool = False) -> Iterator[None]:
    """Record signals in the block; the second of a kind ends the process at once.

    A signal that the process ignores from its start, as background jobs of shell scripts do
    SIGINT, is handled only if `even_ignored`; SIGHUP, which nohup ignores, never. If the process
    runs `until_exit` of the block, a later signal is ignored: it would change the exit status of
    work that is complete. A nested block changes nothing.
    """
    global _is_handling
    if _is_handling:
        yield
        return
    _received.clear()
    _is_handling = True
    previous = {number: signal.signal(number, _record) for number in SIGNALS
                if signal.getsignal(number) != signal.SIG_IGN
                or (even_ignored and number != signal.SIGHUP)}
    try:
        yield
    finally:
        _is_handling = False
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_IGN if until_exit else handler)


def interrupted() -> bool:
    """Whether a signal was received in the block of `signals_handled` that is running."""
    return _is_handling and bool(_received)


def exit_status() -> int:
    """Return the status of a command that a signal ended: 128 plus the number of the first."""
    return 128 + _received[0][0] if _received else 1


def raise_if_interrupted(kept: str = '') -> None:
    """Raise Interrupted, with the text `kept`, if a signal was received."""
    if interrupted():
        raise Interrupted(kept)


def sleep(seconds: float) -> None:
    """Sleep, and raise Interrupted soon after a signal."""
    end = time.monotonic() + seconds
    while (remaining := end - time.monotonic()) > 0.0:
        raise_if_interrupted()
        time.sleep(min(remaining, POLL_S))
    raise_if_interrupted()


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Block the signals in this thread: processes started in the block inherit that."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


def _record(number: int, frame: Any) -> None:
    """Record a signal; a repeated one ends the process without any clean-up."""
    now = time.monotonic()
    if any(number == earlier and now - at > BOUNCE_S for earlier, at in _received):
        os._exit(128 + number)
    _received.append((number, now))
