# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of the package's config folder by their bare names, wherever it was installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path

FOLDER = Path('share', 'kfvo_ros', 'config')


def find_config(name: str) -> Path:
    """Return the file of this path, else that of the config folder, else the path as it is."""
    given = Path(name).expanduser()
    if given.exists() or given.name != name:
        return given
    package = Path(__file__).resolve().parent
    # colcon's prefix holds lib/pythonX/site-packages/kfvo_ros.
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix,
                *map(str, package.parents[2:4])]
    folders = [package.parent / 'config',
               *(Path(prefix) / FOLDER for prefix in prefixes if prefix)]
    return next((folder / name for folder in folders if (folder / name).is_file()), given)
