# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files: atomic writes, bounded reads, YAML, text tables, and the files of the config folder."""

from __future__ import annotations

import errno
import fcntl
import io
import math
import os
import stat
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeVar

import yaml

from kfvo_ros.errors import KfvoError, reason_of

MALFORMED_YAML = (yaml.YAMLError, ValueError, LookupError, AttributeError, ArithmeticError,
                  RecursionError)
"""Exceptions of PyYAML, including those of its constructors of dates and numbers."""
MAX_YAML_BYTES, MAX_TABLE_BYTES = 2 ** 20, 2 ** 30
"""Largest YAML file (PyYAML takes seconds for it) and largest text table."""
ENCODING = 'utf-8-sig'
"""UTF-8, with or without the byte order mark that editors on Windows write."""
_KINDS = {stat.S_IFDIR: 'a folder', stat.S_IFIFO: 'a FIFO', stat.S_IFSOCK: 'a socket'}
Parsed = TypeVar('Parsed')
CONFIG_FOLDER = Path('share', 'kfvo_ros', 'config')
LOCK_TIMEOUT_S, LOCK_POLL_S = 2.0, 0.05
"""Time to wait for a lock: after a process was killed, its children may take a moment to end."""


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


@contextmanager
def locked(folder: Path, beside: bool = False) -> Iterator[None]:
    """Keep other processes out of a folder, by a lock file in it, while the block runs.

    The folder is made, and removed if it stays empty; it is left alone where the lock file is
    `beside` it. The kernel releases the lock of a process that ends in any way. Raises KfvoError
    if another process holds the lock, or it cannot be written.
    """
    path = folder.with_name(f'.{folder.name}.lock') if beside else folder / '.lock'
    is_new = not path.parent.exists()
    try:
        lock = _lock(path, folder)
    except OSError as error:
        raise KfvoError(f'cannot write to {folder}: {reason_of(error)}') from error
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()
            if is_new:
                path.parent.rmdir()
        os.close(lock)


def _lock(path: Path, folder: Path) -> int:
    """Return the descriptor of a locked file; OSError, KfvoError if another process holds it."""
    end = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(lock, 20).decode('ascii', 'replace').strip()
            os.close(lock)
            if time.monotonic() > end:
                raise KfvoError(f'{folder} is in use by process {holder}: wait until it ends, '
                                'or choose another folder') from None
            time.sleep(LOCK_POLL_S)
            continue
        except OSError:  # this file system has no locks
            return lock
        if path.exists() and os.path.samestat(os.fstat(lock), os.stat(path)):
            with suppress(OSError):  # the disk may be full
                os.ftruncate(lock, 0)
                os.write(lock, f'{os.getpid()}\n'.encode())
            return lock
        os.close(lock)  # the previous holder removed this file after it was opened


def user_path(text: str) -> Path:
    """Return the path of a text in which ``~`` is a home; one of an unknown user stays as it is.

    Path.expanduser raises RuntimeError for that.
    """
    return Path(os.path.expanduser(text))


def open_file(path: Path, most: int = sys.maxsize) -> IO[bytes]:
    """Open a file of at most `most` bytes for reading; OSError for anything that is no file.

    A FIFO would block until there is a writer, a device might never end.
    """
    try:
        status = os.stat(path)
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, str(error)) from error
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        raise OSError(errno.EINVAL, f'expected a file, found {_KINDS.get(kind, "a device")}')
    if status.st_size > most:
        raise OSError(errno.EFBIG, f'expected at most {most} bytes, found {status.st_size}')
    return open(path, 'rb')


def read_text(path: Path, most: int = MAX_YAML_BYTES) -> str:
    """Return a text file of UTF-8; OSError as `open_file` does, UnicodeDecodeError."""
    with open_file(path, most) as file:
        return file.read().decode(ENCODING)


def read_yaml(path: Path, what: str = '') -> Any:
    """Return the content of a YAML file; raises KfvoError, with `what` before the path."""
    try:
        return parse_yaml(read_text(path))
    except (OSError, *MALFORMED_YAML) as error:
        raise KfvoError(f'cannot read {what}{path}: {reason_of(error)}') from error


def parse_yaml(text: str) -> Any:
    """Return the content of a YAML text; raises one of MALFORMED_YAML.

    Lines that start with % are skipped: OpenCV's ``%YAML:1.0`` is not valid YAML. Its matrices
    are mappings of rows, cols and data.
    """
    lines = (line for line in text.splitlines() if not line.startswith('%'))
    return yaml.load('\n'.join(lines), _Loader)


class _Loader(yaml.SafeLoader):
    """Loads plain data. A few lines of aliases can stand for more values than memory holds."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node; raises YAMLError for an alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f'*{self.peek_event().anchor} is an alias, which is not '
                                 'supported here; write the value out')
        return super().compose_node(parent, index)


_Loader.add_constructor('tag:yaml.org,2002:opencv-matrix',
                        lambda loader, node: loader.construct_mapping(node, deep=True))


def read_rows(path: Path, form: str, parse: Callable[[str], Parsed]) -> list[Parsed]:
    """Return every line parsed, except empty lines and ``#`` comments.

    `parse` raises ValueError or IndexError for a line that is not of the `form`, a description
    for the message. Raises KfvoError with file and line then, and for an unreadable file.
    """
    rows = []
    for number, line in read_lines(path):
        try:
            rows.append(parse(line))
        except (ValueError, IndexError) as error:
            raise KfvoError(f'{path}, line {number}: expected "{form}", '
                            f'found {line[:80]!r}') from error
    return rows


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (number, stripped line) of each line that is neither empty nor a ``#`` comment.

    Raises KfvoError for an unreadable file.
    """
    try:
        with io.TextIOWrapper(open_file(path, MAX_TABLE_BYTES), ENCODING) as file:
            for number, line in enumerate(file, 1):
                stripped = line.strip()
                if stripped and not stripped.startswith('#'):
                    yield number, stripped
    except (OSError, UnicodeDecodeError) as error:
        raise KfvoError(f'cannot read {path}: {reason_of(error)}') from error


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
    given = user_path(name)
    if given.exists() or given.name != name:
        return given
    package = Path(__file__).resolve().parents[1]
    # colcon's prefix holds lib/pythonX/site-packages/kfvo_ros.
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix,
                *map(str, package.parents[2:4])]
    folders = [package.parent / 'config',
               *(Path(prefix) / CONFIG_FOLDER for prefix in prefixes if prefix)]
    return next((folder / name for folder in folders if (folder / name).is_file()), given)
