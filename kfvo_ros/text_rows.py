# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small text tables, one row per line, as the datasets write them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from kfvo_ros.errors import KfvoError, reason_of

Row = TypeVar('Row')


def read_rows(path: Path, form: str, parse: Callable[[str], Row]) -> list[Row]:
    """Parse every line that is neither empty nor a ``#`` comment.

    `parse` raises ValueError or IndexError at a line that is not of the `form`, which is for
    people; that, and a file that cannot be read, becomes a KfvoError naming file and line.
    """
    try:
        lines = path.read_text(encoding='utf-8').splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise KfvoError(f'cannot read {path}: {reason_of(error)}') from error
    rows = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith('#'):
            continue
        try:
            rows.append(parse(line.strip()))
        except (ValueError, IndexError) as error:
            raise KfvoError(f'{path}, line {number}: expected "{form}", '
                            f'found {line[:80]!r}') from error
    return rows


def parse_floats(fields: Iterable[str], count: int) -> list[float]:
    """Return exactly `count` finite numbers; ValueError otherwise."""
    numbers = [float(field) for field in fields]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f'expected {count} finite numbers')
    return numbers


def parse_pose(fields: Iterable[str]) -> list[float]:
    """Return a position and a quaternion in the order of `fields`; ValueError for no rotation."""
    numbers = parse_floats(fields, 7)
    if math.hypot(*numbers[3:]) < 1e-3:
        raise ValueError('a quaternion of zeros')
    return numbers
