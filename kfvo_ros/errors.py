# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The exceptions that users read, and one-line texts of all others."""

from __future__ import annotations


class KfvoError(Exception):
    """Bad input or an impossible request, described in one line.

    The message says what was expected, what came and what to do. Commands print it without a
    traceback and exit with status 1; results already computed are kept.
    """


class MemoryFullError(KfvoError):
    """Out of memory; retrying will not help."""


def reason_of(error: Exception) -> str:
    """Return the text of an exception in one line.

    The text of an OSError is its reason without the file name, which the caller adds.
    """
    text = (isinstance(error, OSError) and error.strerror) or str(error)
    return ' '.join(text.split()) or type(error).__name__
