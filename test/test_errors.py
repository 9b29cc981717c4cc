# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages are one printable line of bounded length."""

from __future__ import annotations

import pytest

from kfvo_ros.errors import MAX_LINE, KfvoError, MemoryFullError, printable, quoted, reason_of


@pytest.mark.parametrize(('text', 'line'), [
    ('plain', 'plain'), ('two\u00a0words\u3000more', 'two\u00a0words\u3000more'),
    ('Ümläut ☃', 'Ümläut ☃'), ('a\nb\tc', 'a\\nb\\tc'),
    ('\x1b[2Jgone\x07', '\\x1b[2Jgone\\x07'), ('\x9b31m', '\\x9b31m'), ('a\u202eb', 'a\\u202eb'),
    ('\udcff', '\\udcff'), ('\U000e0001', '\\U000e0001')])
def test_control_characters_are_escaped(text, line):
    assert printable(text) == line
    assert str(KfvoError(text)) == str(MemoryFullError(text)) == line
    assert reason_of(ValueError(text)) == printable(' '.join(text.split()))


def test_long_lines_keep_their_ends():
    assert printable('x' * MAX_LINE) == 'x' * MAX_LINE
    for text in ('a' + 'x' * 500, 'a' + 'x' * 10 ** 7, 'a' + '\x1b' * 499):
        line = printable(text + ' and the advice')
        assert len(line) == MAX_LINE and ' ... ' in line
        assert line.startswith('a') and line.endswith(' and the advice')
    inner = KfvoError('reason ' + 'x' * 1000)
    assert len(str(KfvoError(f'path: {inner}; do this'))) == MAX_LINE


def test_values_without_a_short_text_are_quoted():
    nested: list = []
    for _ in range(100_000):
        nested = [nested]
    assert quoted('a\x1b') == "'a\\x1b'"
    assert quoted(1 << 20_000) == 'a value of type int that is too long to show'
    assert quoted(nested) == 'a value of type list that is too long to show'
    assert len(quoted('x' * 10 ** 6)) == MAX_LINE
