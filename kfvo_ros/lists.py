# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options that are several words or numbers with commas in between, each taken once."""

from __future__ import annotations

from collections.abc import Iterable

from kfvo_ros.errors import KfvoError


def names_in(text: str, what: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return the names of ``a,b,...``; raises KfvoError for one that is not `known`."""
    known, names = tuple(known), tuple(dict.fromkeys(text.split(',')))
    for name in names:
        if name not in known:
            raise KfvoError(f'{what}: expected names out of {", ".join(known)}, came {name!r}')
    return names


def numbers_in(text: str, what: str, least: int = 0) -> tuple[int, ...]:
    """Return the whole numbers of ``1,2,...``; raises KfvoError for one below `least`."""
    parts = text.split(',')
    if not all(part.isascii() and part.isdigit() and int(part) >= least for part in parts):
        raise KfvoError(f'{what}: expected whole numbers from {least} with commas in between, '
                        f'came {text!r}')
    return tuple(dict.fromkeys(map(int, parts)))
