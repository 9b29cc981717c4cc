# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables as Markdown: the best of a column bold, the second best underlined."""

from __future__ import annotations

import re
from collections.abc import Iterator

from kfvo_ros.benchmarking.tables import Cell, Table

FORMS = {'best': '**{}**', 'second': '<u>{}</u>', None: '{}'}
SPECIAL = re.compile(r'([\\`*<>|])')


def markdown(table: Table) -> str:
    """Return the table under a heading, its notes below."""
    return '\n'.join((f'## {escaped(table.title)}', '', *_grid(table), '',
                      *(f'{escaped(note)}  ' for note in table.notes), ''))


def escaped(text: str) -> str:
    """Return what Markdown shows as this text."""
    return SPECIAL.sub(r'\\\1', text)


def _grid(table: Table) -> Iterator[str]:
    yield _line(map(escaped, table.head))
    yield _line('---' if index < table.words else '---:' for index in range(len(table.head)))
    for row in table.rows:
        yield _line(map(_cell, row))


def _cell(cell: Cell) -> str:
    return FORMS[cell.mark].format(escaped(cell.text))


def _line(texts: Iterator[str]) -> str:
    return f'| {" | ".join(texts)} |'
