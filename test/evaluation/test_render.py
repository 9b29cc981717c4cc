# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables as Markdown and LaTeX, and the HTML page: well formed, complete, self-contained."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmark_rows import make_rows

from kfvo_ros.evaluation.render import Cell, Table, latex, markdown, write_page
from kfvo_ros.evaluation.report import Provenance, make_tables

VOID = {'meta', 'img', 'br'}
UNSAFE = '<script src="https://example.org/x.js"></script> & "2 < 3" \u2717'
TABLE = Table('ATE [m] & more', ('Method', 'MH01', 'MH02', 'Avg'),
              ((Cell('every'), Cell('2.74', 'best'), Cell('2.90', 'second'), Cell('2.82')),
               (Cell(UNSAFE), Cell('3.48'), Cell(''), Cell('\u2013'))),
              ('aligned by Sim(3)', UNSAFE))
SPECIAL = Table('A & B_c', ('Method', 'x|y', '100 %'),
             ((Cell('a_b'), Cell('1.0', 'best'), Cell('2 † (1–3)', 'second')),
              (Cell('[c] <d>'), Cell('✓'), Cell('–'))), ('cost: $5 #1 {x} ~ ^ \\',), rules=(1,))


class PageParser(HTMLParser):
    """Collects elements; fails at a closing tag without its opening tag."""

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

    def count(self, tag: str, **attributes: str) -> int:
        """Return the number of elements with these attributes (``class_`` for class)."""
        wanted = {name.rstrip('_'): value for name, value in attributes.items()}
        return sum(name == tag and wanted.items() <= found.items()
                   for name, found in self.elements)


@pytest.fixture
def figures(tmp_path: Path) -> list[Path]:
    """Return two PNG files of different sizes."""
    paths = [tmp_path / 'trajectories.png', tmp_path / 'errors.png']
    for path, height in zip(paths, (20, 30)):
        cv2.imwrite(str(path), np.full((height, 40, 3), height, dtype=np.uint8))
    return paths


def read(path: Path) -> PageParser:
    """Return the parsed page, all of whose tags are closed."""
    parser = PageParser()
    parser.feed(path.read_text(encoding='utf-8'))
    parser.close()
    assert not parser.open
    return parser


# Markdown and LaTeX


def test_markdown():
    lines = markdown(SPECIAL).splitlines()
    assert lines[0] == '## A & B_c'
    assert lines[2:6] == ['| Method | x\\|y | 100 % |', '| --- | ---: | ---: |',
                          '| a_b | **1.0** | <u>2 † (1–3)</u> |', '| [c] \\<d\\> | ✓ | – |']
    assert lines[7] == 'cost: $5 #1 {x} ~ ^ \\\\  '


def test_latex_marks_and_escapes():
    text = latex([SPECIAL])
    assert r'a\_b & \colorbox{red!50}{1.0} & \colorbox{orange!50}{2 $\dagger$ (1--3)} \\' in text
    assert r'{[}c{]} \textless{}d\textgreater{} & \textcolor{green}{\ding{51}} & -- \\' in text
    assert r'\$5 \#1 \{x\} \textasciitilde{} \textasciicircum{} \textbackslash{}' in text
    assert r'\begin{tabular}{l|cc}' in text and text.count(r'\midrule') == 2


def test_latex_is_well_formed():
    rows = [*make_rows('EuRoC', 'MH01', {'every': [1.0, 2.0], 'survival': [2.0, 3.0]}),
            *make_rows('KITTI', '03', {'every': [1.0], 'survival': [2.0]})]
    text = latex([*make_tables(rows, Provenance('a command', '0.1.0', None, None)), SPECIAL])
    assert text.isascii()
    stack = []
    for kind, name in re.findall(r'\\(begin|end)\{([a-z*]+)\}', text):
        if kind == 'begin':
            stack.append(name)
        else:
            assert stack.pop() == name
    assert not stack
    assert len(re.findall(r'(?<!\\)\{', text)) == len(re.findall(r'(?<!\\)\}', text))
    tables = re.findall(r'\\begin\{tabular\}\{(.*?)\}\n(.*?)\\end\{tabular\}', text, re.S)
    assert len(tables) == 7
    for spec, body in tables:
        lines = [line for line in body.splitlines() if '&' in line]
        counts = {len(re.findall(r'(?<!\\)&', line)) + 1 for line in lines}
        assert counts == {len(spec.replace('|', ''))} and len(lines) > 1
        assert all(line.endswith(r' \\') for line in lines)


# HTML


def test_the_page_holds_all_tables_with_marks(tmp_path):
    write_page(tmp_path / 'report.html', 'A & B', [TABLE, TABLE], [])
    page = read(tmp_path / 'report.html')
    assert page.texts['title'] == page.texts['h1'] == ['A & B']
    assert page.texts['h2'] == ['ATE [m] & more'] * 2
    assert page.texts['th'] == 2 * [*TABLE.head, 'every', UNSAFE]
    assert page.texts['td'] == 2 * ['2.74', '2.90', '2.82', '3.48', '', '\u2013']
    assert page.texts['li'] == 2 * list(TABLE.notes)
    assert page.count('table') == 2 and page.count('tr') == 6
    assert page.count('th', scope='col') == 8 and page.count('th', scope='row') == 4
    assert page.count('td', class_='best') == page.count('td', class_='second') == 2


def test_figures_are_embedded(tmp_path, figures):
    write_page(tmp_path / 'report.html', 'A', [], figures)
    page = read(tmp_path / 'report.html')
    sources = [found['src'] for name, found in page.elements if name == 'img']
    assert len(sources) == 2
    for source, path in zip(sources, figures):
        kind, _, data = source.partition(',')
        assert kind == 'data:image/png;base64'
        content = base64.b64decode(data, validate=True)
        assert content == path.read_bytes()
        decoded = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(decoded, cv2.imread(str(path)))
    assert page.texts['figcaption'] == ['trajectories', 'errors']


def test_the_page_loads_no_resources_and_runs_no_scripts(tmp_path, figures):
    write_page(tmp_path / 'report.html', UNSAFE, [TABLE], figures)
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


def test_the_page_supports_narrow_screens_and_dark_mode(tmp_path):
    write_page(tmp_path / 'report.html', 'A', [TABLE], [])
    page = read(tmp_path / 'report.html')
    style = ''.join(page.texts['style'])
    assert style.count('{') == style.count('}')
    assert 'prefers-color-scheme: dark' in style
    assert page.count('meta', name='viewport',
                      content='width=device-width, initial-scale=1') == 1
    assert page.count('html', lang='en') == page.count('meta', charset='utf-8') == 1
    # A wide table scrolls in its box, not the page with it.
    assert page.count('div', class_='wide') == 1 and '.wide { overflow-x: auto; }' in style


def test_a_page_is_replaced_atomically(tmp_path, figures):
    page = tmp_path / 'report.html'
    write_page(page, 'first', [TABLE], [])
    with pytest.raises(FileNotFoundError):
        write_page(page, 'second', [TABLE], [*figures, tmp_path / 'missing.png'])
    assert read(page).texts['title'] == ['first']
    assert {each.name for each in tmp_path.iterdir()} == {'report.html', 'trajectories.png',
                                                          'errors.png'}
