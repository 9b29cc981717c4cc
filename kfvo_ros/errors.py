# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The exceptions that users read, and one-line texts of all others."""

from __future__ import annotations

import unicodedata
from typing import Any

MAX_LINE = 500
"""Longest line of a message; of a longer one the middle is left out."""
LINE_END = 150
"""Characters kept at the end of a cut line, where the advice is."""


class KfvoError(Exception):
    """Bad input or an impossible request, described in one line.

    The message says what was expected, what came and what to do. Commands print it without a
    traceback and exit with status 1; results already computed are kept. What it quotes comes
    from files, topics and policies, so it is made `printable`.
    """

    def __init__(self, message: str = '') -> None:
        super().__init__(printable(message))


class MemoryFullError(KfvoError):
    """Out of memory; retrying will not help."""


def printable(text: str) -> str:
    """Return a text as one line of at most MAX_LINE characters, control characters escaped."""
    ends = text[:MAX_LINE] + text[MAX_LINE:][-MAX_LINE:]
    line = ''.join(char if char.isprintable() or unicodedata.category(char) == 'Zs' else
                   char.encode('unicode_escape').decode('ascii') for char in ends)
    if len(line) <= MAX_LINE:
        return line
    return f'{line[:MAX_LINE - LINE_END - 5]} ... {line[-LINE_END:]}'


def quoted(value: Any) -> str:
    """Return the `printable` repr of a value of a file, also where it has none."""
    try:
        return printable(repr(value))
    except (ValueError, RecursionError):  # an int of many digits, a list in a list in ...
        return f'a value of type {type(value).__name__} that is too long to show'


def reason_of(error: Exception) -> str:
    """Return the text of an exception in one line.

    The text of an OSError is its reason without the file name, which the caller adds.
    """
    text = (isinstance(error, OSError) and error.strerror) or str(error)
    return printable(' '.join(text.split())) or type(error).__name__
