# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the loops of this backbone are compiled: once, kept on disk, free of the interpreter.

Whoever changes a compiled function that another file calls (those of schur.py) has to remove that
file's part of the cache, in __pycache__: the compiler looks at the caller's file only.
"""

from __future__ import annotations

import numba

compiled = numba.njit(cache=True, nogil=True, error_model='numpy',
                      fastmath={'contract', 'reassoc'})
"""Sums may be taken in any order, which lets the processor take several terms at a time."""
