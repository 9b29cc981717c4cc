# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands that setup.py names before they exist."""

from __future__ import annotations

import sys
from pathlib import Path

from kfvo_ros import __version__


def not_in_this_version() -> int:
    """Say on stderr that the command called is still to come; return exit status 1."""
    command = Path(sys.argv[0]).name
    print(f'{command} is not part of kfvo_ros {__version__}; kfvo_run, kfvo_node, kfvo_convert '
          'and kfvo_play are', file=sys.stderr)
    return 1
