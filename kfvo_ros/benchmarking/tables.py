# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables before anybody decides whether they become Markdown, LaTeX or HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Mark = Literal['best', 'second']
YES, NO, NONE = '✓', '✗', '–'


@dataclass(frozen=True)
class Cell:
    """One plain text, and whether it is the best or second best of its column."""

    text: str
    mark: Mark | None = None


@dataclass(frozen=True)
class Table:
    """``head`` (columns), ``rows`` of as many cells, and ``notes`` to print below.

    The first ``words`` columns hold words, the others numbers, of which the last sums up the
    others if ``total``; ``rules`` are the rows above which a line is drawn.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()
    words: int = 1
    total: bool = False
    rules: tuple[int, ...] = ()


def number(value: float | None, decimals: int) -> str:
    """Return the number, or a dash for none."""
    return NONE if value is None else f'{value:.{decimals}f}'


def marks(values: Sequence[float | None], decimals: int) -> list[Mark | None]:
    """Return the marks of a column in which less is better; what prints alike ranks alike.

    Where there is nothing to compare, nothing is marked.
    """
    printed = [None if value is None else round(value, decimals) for value in values]
    ranks = sorted({value for value in printed if value is not None})
    if len(values) - printed.count(None) < 2:
        return [None] * len(values)
    best, second = (*ranks, None)[:2]
    return [None if value is None else 'best' if value == best
            else 'second' if value == second else None for value in printed]


def rules_between(*ends: int) -> tuple[int, ...]:
    """Return the rules between groups of rows that end there, the last with the table."""
    return tuple(sorted({end for end in ends[:-1] if 0 < end < ends[-1]}))
