# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files: atomic writes, YAML, text tables and the config folder."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import yaml

from kfvo_ros.errors import KfvoError, reason_of

MALFORMED_YAML = (yaml.YAMLError, ValueError, LookupError, AttributeError, ArithmeticError,
                  RecursionError)
"""Exceptions of PyYAML, including those of its constructors of dates and numbers."""
Parsed = TypeVar('Parsed')
CONFIG_FOLDER = Path('share', 'kfvo_ros', 'config')


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a draft path beside `path`; at the end the draft replaces `path` in one step.

    Readers see the old file until then; after an error it stays.
    """
    draft = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        yield draft
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def read_yaml(path: Path, what: str = '') -> Any:
    """Return the content of a YAML file; raises KfvoError, with `what` before the path.

    Lines that start with % are skipped: OpenCV's ``%YAML:1.0`` is not valid YAML.
    """
    try:
        lines = path.read_text(encoding='utf-8').splitlines()
        return yaml.safe_load('\n'.join(line for line in lines if not line.startswith('%')))
    except (OSError, *MALFORMED_YAML) as error:
        raise KfvoError(f'cannot read {what}{path}: {reason_of(error)}') from error


def read_rows(path: Path, form: str, parse: Callable[[str], Parsed]) -> list[Parsed]:
    """Return every line parsed, except empty lines and ``#`` comments.

    `parse` raises ValueError or IndexError for a line that is not of the `form`, a description
    for the message. Raises KfvoError with file and line then, and for an unreadable file.
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
    """Return position and quaternion in the order of `fields`; ValueError for a zero norm."""
    numbers = parse_floats(fields, 7)
    if math.hypot(*numbers[3:]) < 1e-3:
        raise ValueError('a quaternion of zeros')
    return numbers


def find_config(name: str) -> Path:
    """Return the path if it exists, else the file of this name in the config folder if it exists.

    The config folder is that of the checkout or of the installation (share/kfvo_ros/config).
    Returns the path itself where neither exists.
    """
    given = Path(name).expanduser()
    if given.exists() or given.name != name:
        return given
    package = Path(__file__).resolve().parents[1]
    # colcon's prefix holds lib/pythonX/site-packages/kfvo_ros.
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix,
                *map(str, package.parents[2:4])]
    folders = [package.parent / 'config',
               *(Path(prefix) / CONFIG_FOLDER for prefix in prefixes if prefix)]
    return next((folder / name for folder in folders if (folder / name).is_file()), given)
