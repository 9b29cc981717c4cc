# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compilation by numba, with a cache of machine code on disk that is checked when it is read.

Numba looks machine code up by the function's name and source file, but the code also contains
callees from other files and the layout of named tuples. Every compiled function therefore carries
a digest of all those sources in its name, so that outdated machine code is never run.

Numba trusts its files: an empty or cut one raises, and a flipped bit of machine code may crash the
process. Here each file ends with a digest of its content; what does not match is compiled again.
"""

from __future__ import annotations

import hashlib
import io
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeVar

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache

from kfvo_ros.errors import reason_of
from kfvo_ros.utils.files import open_file

Kernel = TypeVar('Kernel', bound=Callable[..., Any])

MARKS = (b'@compiled', b'@entry_point', b'(NamedTuple)')
"""A source file with one of these contributes to machine code."""
DIGEST_BYTES = hashlib.sha256().digest_size

_log = logging.getLogger(__name__)
# The first start takes a minute, which commands should explain although they log warnings only.
_log.setLevel(logging.INFO)
_logged: set[str] = set()


class Compiler:
    """Decorator for a function of arrays, numbers and named tuples: compiles it when called.

    `folder` holds the sources of all functions and named tuples that call or contain each other;
    `options` are those of numba.njit.
    """

    def __init__(self, folder: Path, **options: Any) -> None:
        self._options = options
        self._digest = _source_digest(folder)

    def __call__(self, function: Kernel) -> Kernel:
        """Return the function, to be compiled for the types of each call."""
        function.__qualname__ += f'_{self._digest}'
        kernel = numba.njit(**self._options)(function)
        try:
            kernel._cache = _CheckedCache(function)
        except RuntimeError:  # no folder of numba's list is writable
            kernel._cache = _NoCache()
        return kernel


def _source_digest(folder: Path) -> str:
    """Return 8 hex digits of a hash over all sources with compiled functions or named tuples."""
    sources = [path.read_bytes() for path in sorted(folder.glob('*.py'))]
    return hashlib.sha256(b''.join(
        source for source in sources if any(mark in source for mark in MARKS))).hexdigest()[:8]


class _CheckedFiles(IndexDataCacheFile):
    """Index and data files of one function, each followed by a digest of its content."""

    def load(self, key: Any) -> Any:
        """Return what was saved under the key, None where it is missing or damaged."""
        saved = super().load(key)
        return saved[1] if saved is not None and saved[0] == key else None

    def save(self, key: Any, data: Any) -> None:
        """Save with the key: two processes that save at once may give one name to two files."""
        super().save(key, (key, data))

    def _load_index(self) -> dict[Any, str]:
        return super()._load_index() if _is_intact(Path(self._index_path)) else {}

    def _load_data(self, name: str) -> Any:
        return super()._load_data(name) if _is_intact(Path(self._data_path(name))) else None

    @contextmanager
    def _open_for_write(self, path: str) -> Iterator[IO[bytes]]:
        with super()._open_for_write(path) as file:
            content = io.BytesIO()
            yield content
            file.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())


class _CheckedCache(FunctionCache):
    """Numba's cache of one function; raises RuntimeError where no folder is writable."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _CheckedFiles(self._cache_path, self._impl.filename_base,
                                         self._impl.locator.get_source_stamp())

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the machine code for a signature, None where it must be compiled."""
        try:
            found = super().load_overload(signature, target_context)
        except Exception as error:  # unpickling may raise anything
            _log_damage(Path(self._cache_path), reason_of(error))
            found = None
        if found is None:
            _announce_compilation()
        return found

    def save_overload(self, signature: Any, result: Any) -> None:
        """Save machine code; without room for it the next start compiles again."""
        try:
            super().save_overload(signature, result)
        except OSError as error:
            _log_once(logging.WARNING, 'cannot keep compiled code in %s: %s; the next start '
                      'compiles again', self._cache_path, reason_of(error))


class _NoCache(NullCache):
    """Takes the place of a cache where no folder is writable."""

    def load_overload(self, signature: Any, target_context: Any) -> None:
        """Return None: every start compiles."""
        _log_once(logging.WARNING, 'cannot keep compiled code: neither the folder of kfvo_ros nor '
                  "the user's cache folder is writable; every start compiles again unless "
                  'NUMBA_CACHE_DIR names a writable folder')
        _announce_compilation()


def _is_intact(path: Path) -> bool:
    """Whether a file exists and ends with the digest of its content."""
    try:
        with open_file(path) as file:
            content = file.read()
    except FileNotFoundError:
        return False
    except OSError as error:
        _log_damage(path.parent, reason_of(error))
        return False
    if hashlib.sha256(content[:-DIGEST_BYTES]).digest() == content[-DIGEST_BYTES:]:
        return True
    _log_damage(path.parent, 'a digest does not match')
    return False


def _log_damage(folder: Path, problem: str) -> None:
    _log_once(logging.WARNING, 'compiled code in %s is damaged (%s): compiling again', folder,
              problem)


def _announce_compilation() -> None:
    _log_once(logging.INFO, 'compiling for this processor (first start), which may take a minute')


def _log_once(level: int, text: str, *arguments: object) -> None:
    """Log a text once per process, whatever its arguments."""
    if text not in _logged:
        _logged.add(text)
        _log.log(level, text, *arguments)
