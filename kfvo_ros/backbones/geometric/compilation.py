# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the loops of this backbone are compiled: once, kept on disk, free of the interpreter.

What is kept is found by a function's name and the age of its file. But machine code also holds
what is called in other files, and the layout of the tuples that come and go: a new version of
those would be run by old code. So all that is compiled here has their digest in its name.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numba

_compile = numba.njit(cache=True, nogil=True, error_model='numpy',
                      fastmath={'contract', 'reassoc'})
"""Sums may be taken in any order, which lets the processor take several terms at a time."""


def _digest() -> str:
    """Return a few digits that another version of any of the sources changes."""
    sources = [path.read_bytes() for path in sorted(Path(__file__).parent.glob('*.py'))]
    return hashlib.sha256(b''.join(
        source for source in sources if b'@compiled' in source or b'(NamedTuple)' in source)
    ).hexdigest()[:8]


_DIGEST = _digest()


def compiled(function: Any) -> Any:
    """Compile a function of arrays, numbers and named tuples when it is called first."""
    function.__qualname__ += f'_{_DIGEST}'
    return _compile(function)
