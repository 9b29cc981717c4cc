# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""YAML files that a user names: whatever is wrong with one is told in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from kfvo_ros.errors import KfvoError, reason_of

MALFORMED = (yaml.YAMLError, ValueError, LookupError, AttributeError, ArithmeticError,
             RecursionError)
"""What PyYAML raises, its constructors of dates and numbers too."""


def read_yaml(path: Path, what: str = '') -> Any:
    """Return what a file holds; raises KfvoError that it cannot be read, and as `what`.

    Lines that start with % are left out: OpenCV's ``%YAML:1.0`` is no YAML.
    """
    try:
        lines = path.read_text(encoding='utf-8').splitlines()
        return yaml.safe_load('\n'.join(line for line in lines if not line.startswith('%')))
    except (OSError, *MALFORMED) as error:
        raise KfvoError(f'cannot read {what}{path}: {reason_of(error)}') from error
