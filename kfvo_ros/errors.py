# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The one exception that a user is meant to read."""


class KfvoError(Exception):
    """Bad input or an impossible request, told in one line.

    The message says what was expected, what came and what to do. Commands print it without a
    traceback and exit with status 1; everything already computed is kept.
    """
