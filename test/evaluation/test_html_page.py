# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a benchmark: well formed, alone, and with everything in it."""

from __future__ import annotations

import base64
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from kfvo_ros.evaluation.render import Cell, Table, write_page

VOID = {'meta', 'img', 'br'}
NASTY = '<script src="https://example.org/x.js"></script> & "2 < 3" \u2717'
TABLE = Table('ATE [m] & more', ('Method', 'MH01', 'MH02', 'Avg'),
              ((Cell('every'), Cell('2.74', 'best'), Cell('2.90', 'second'), Cell('2.82')),
               (Cell(NASTY), Cell('3.48'), Cell(''), Cell('\u2013'))),
              ('aligned by Sim(3)', NASTY))


class Reader(HTMLParser):
    """Collects elements, and fails at a tag that closes what is not open."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
            self.texts.setdefault(tag, []).append('')

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f'</{tag}> closes {self.open}'
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if self.open:
            self.texts[self.open[-1]][-1] += data

    def having(self, tag: str, **attributes: str) -> int:
        """Return the number of elements with these attributes (``class_`` for class)."""
        wanted = {name.rstrip('_'): value for name, value in attributes.items()}
        return sum(name == tag and wanted.items() <= found.items()
                   for name, found in self.elements)


@pytest.fixture
def pictures(tmp_path: Path) -> list[Path]:
    """Return two pictures of different sizes."""
    paths = [tmp_path / 'trajectories.png', tmp_path / 'errors.png']
    for path, height in zip(paths, (20, 30)):
        cv2.imwrite(str(path), np.full((height, 40, 3), height, dtype=np.uint8))
    return paths


def read(path: Path) -> Reader:
    """Return the parsed page, all of whose tags are closed."""
    reader = Reader()
    reader.feed(path.read_text(encoding='utf-8'))
    reader.close()
    assert not reader.open
    return reader


def test_tables_are_all_there_and_marked(tmp_path):
    write_page(tmp_path / 'report.html', 'A & B', [TABLE, TABLE], [])
    page = read(tmp_path / 'report.html')
    assert page.texts['title'] == page.texts['h1'] == ['A & B']
    assert page.texts['h2'] == ['ATE [m] & more'] * 2
    assert page.texts['th'] == 2 * [*TABLE.head, 'every', NASTY]
    assert page.texts['td'] == 2 * ['2.74', '2.90', '2.82', '3.48', '', '\u2013']
    assert page.texts['li'] == 2 * list(TABLE.notes)
    assert page.having('table') == 2 and page.having('tr') == 6
    assert page.having('th', scope='col') == 8 and page.having('th', scope='row') == 4
    assert page.having('td', class_='best') == page.having('td', class_='second') == 2


def test_pictures_are_in_the_page(tmp_path, pictures):
    write_page(tmp_path / 'report.html', 'A', [], pictures)
    page = read(tmp_path / 'report.html')
    sources = [found['src'] for name, found in page.elements if name == 'img']
    assert len(sources) == 2
    for source, path in zip(sources, pictures):
        kind, _, data = source.partition(',')
        assert kind == 'data:image/png;base64'
        content = base64.b64decode(data, validate=True)
        assert content == path.read_bytes()
        decoded = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(decoded, cv2.imread(str(path)))
    assert page.texts['figcaption'] == ['trajectories', 'errors']


def test_nothing_is_fetched_and_nothing_runs(tmp_path, pictures):
    write_page(tmp_path / 'report.html', NASTY, [TABLE], pictures)
    page = read(tmp_path / 'report.html')
    names = {name for name, _ in page.elements}
    assert not names & {'script', 'link', 'iframe', 'object', 'embed', 'base', 'form', 'a'}
    for name, found in page.elements:
        assert not any(each.startswith('on') for each in found)
        assert all(found.get(each, 'data:').startswith('data:') for each in ('src', 'href')), name
    style = ''.join(page.texts['style'])
    assert 'url(' not in style and '@import' not in style
    policy = next(found['content'] for name, found in page.elements
                  if found.get('http-equiv') == 'Content-Security-Policy')
    assert policy.startswith("default-src 'none'")


def test_the_page_fits_phones_and_dark_rooms(tmp_path):
    write_page(tmp_path / 'report.html', 'A', [TABLE], [])
    page = read(tmp_path / 'report.html')
    style = ''.join(page.texts['style'])
    assert style.count('{') == style.count('}')
    assert 'prefers-color-scheme: dark' in style
    assert page.having('meta', name='viewport',
                       content='width=device-width, initial-scale=1') == 1
    assert page.having('html', lang='en') == page.having('meta', charset='utf-8') == 1
    # A wide table scrolls in its box, not the page with it.
    assert page.having('div', class_='wide') == 1 and '.wide { overflow-x: auto; }' in style


def test_a_page_is_replaced_as_a_whole(tmp_path, pictures):
    page = tmp_path / 'report.html'
    write_page(page, 'first', [TABLE], [])
    with pytest.raises(FileNotFoundError):
        write_page(page, 'second', [TABLE], [*pictures, tmp_path / 'missing.png'])
    assert read(page).texts['title'] == ['first']
    assert {each.name for each in tmp_path.iterdir()} == {'report.html', 'trajectories.png',
                                                          'errors.png'}
