# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The one exception that a user is meant to read, and the words of all others."""

from __future__ import annotations


class KfvoError(Exception):
    """Bad input or an impossible request, told in one line.

    The message says what was expected, what came and what to do. Commands print it without a
    traceback and exit with status 1; everything already computed is kept.
    """


class MemoryFullError(KfvoError):
    """There is not memory enough; it will not be the next time either."""


def reason_of(error: Exception) -> str:
    """Return what an error of somebody else says, in one line.

    Of an OSError that is the reason alone: whoever reports it names the file.
    """
    text = (isinstance(error, OSError) and error.strerror) or str(error)
    return ' '.join(text.split()) or type(error).__name__
