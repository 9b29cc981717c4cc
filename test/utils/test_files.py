# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files that users name: text of every editor, what is no file, and what is too large."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from kfvo_ros.errors import KfvoError
from kfvo_ros.trajectory import parse_stamp_ns
from kfvo_ros.utils.files import (
    MAX_TABLE_BYTES,
    MAX_YAML_BYTES,
    find_config,
    open_file,
    parse_floats,
    read_rows,
    read_yaml,
    user_path,
)


def read_numbers(path: Path) -> list[int]:
    return read_rows(path, 'a number', int)


@pytest.mark.parametrize('data', [
    b'1\n2\n3\n', b'\xef\xbb\xbf1\r\n2\r\n3', b'1\r2\r3\r',
    b'\xef\xbb\xbf# comment\n\n 1 \n2\n#\n3'])
def test_tables_of_every_editor(data, tmp_path):
    (tmp_path / 'table.txt').write_bytes(data)
    assert read_numbers(tmp_path / 'table.txt') == [1, 2, 3]


def test_yaml_of_every_editor(tmp_path):
    (tmp_path / 'a.yaml').write_bytes(b'\xef\xbb\xbf%YAML:1.0\r\n---\r\na: 1\r\n'
                                      b'b: !!opencv-matrix\r\n  rows: 1\r\n'
                                      b'  data: [ 2., 3.e+00 ]\r\n')
    assert read_yaml(tmp_path / 'a.yaml') == {'a': 1, 'b': {'rows': 1, 'data': [2.0, 3.0]}}


def test_errors_name_the_line(tmp_path):
    (tmp_path / 'table.txt').write_text('# two\n1\ntwo\x1b[2J\n')
    with pytest.raises(KfvoError) as caught:
        read_numbers(tmp_path / 'table.txt')
    message = str(caught.value)
    assert 'table.txt, line 3: expected "a number", found' in message and '\x1b' not in message
    (tmp_path / 'table.txt').write_bytes('1\n'.encode('utf-16'))
    with pytest.raises(KfvoError, match=r"cannot read .*table\.txt: 'utf-8' codec"):
        read_numbers(tmp_path / 'table.txt')


@pytest.mark.parametrize('read', [read_numbers, read_yaml])
@pytest.mark.parametrize(('kind', 'found'), [
    ('folder', 'a folder'), ('fifo', 'a FIFO'), ('device', 'a device'), ('nul', 'null byte'),
    ('missing', 'No such file'), ('loop', 'Too many levels')])
def test_what_is_no_file_is_refused_at_once(read, kind, found, tmp_path):
    path = tmp_path / kind
    if kind == 'folder':
        path.mkdir()
    elif kind == 'fifo':
        os.mkfifo(path)
    elif kind == 'device':
        path.symlink_to('/dev/zero')
    elif kind == 'loop':
        path.symlink_to(path)
    elif kind == 'nul':
        path = tmp_path / 'a\0b'
    with pytest.raises(KfvoError, match=f'cannot read .*{found}'):
        read(path)


@pytest.mark.parametrize(('read', 'most'), [(read_numbers, MAX_TABLE_BYTES),
                                            (read_yaml, MAX_YAML_BYTES)])
def test_huge_files_are_refused(read, most, tmp_path):
    path = tmp_path / 'sparse'
    path.touch()
    os.truncate(path, most + 1)
    with pytest.raises(KfvoError, match=f'expected at most {most} bytes, found {most + 1}'):
        read(path)
    with open_file(path) as file:
        assert file.read(1) == b'\0'


def test_aliases_are_refused(tmp_path):
    """Nine levels of nine aliases are a billion values when they are shown or merged."""
    lines = ['a0: &a0 [x, x]'] + [f'a{n}: &a{n} [{", ".join([f"*a{n - 1}"] * 9)}]'
                                  for n in range(1, 10)]
    for text in ('\n'.join(lines), 'a: &a {b: 1}\nc: {<<: *a}', 'a: &a [*a]'):
        (tmp_path / 'bomb.yaml').write_text(text)
        with pytest.raises(KfvoError, match=r'cannot read the recipe .*bomb\.yaml: \*a0? is an '
                                            'alias, which is not supported'):
            read_yaml(tmp_path / 'bomb.yaml', 'the recipe ')


def test_the_home_of_nobody(tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    assert user_path('~/a') == tmp_path / 'a'
    assert user_path('~no such user/a') == Path('~no such user/a')
    assert find_config('~no-such-user/a.yaml') == Path('~no-such-user/a.yaml')


def test_a_million_rows_are_read_in_seconds(tmp_path):
    count = 100_000
    with (tmp_path / 'truth.tum').open('w') as file:
        file.writelines(f'{1e9 + 0.005 * n:.9f} {n}.125 0.5 -0.25 0.5 0.5 -0.5 0.5\n'
                        for n in range(count))

    def parse(line: str) -> tuple[int, list[float]]:
        stamp, *fields = line.split()
        return parse_stamp_ns(stamp), parse_floats(fields, 7)

    start = time.process_time()
    rows = read_rows(tmp_path / 'truth.tum', 'a pose', parse)
    assert time.process_time() - start < 2.5  # about 0.6, and ten times that for a million
    assert len(rows) == count and rows[-1][1][0] == count - 1 + 0.125
