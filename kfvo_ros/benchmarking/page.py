# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A page that holds all of a benchmark: one HTML file that opens without network."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from kfvo_ros.atomic import replaced
from kfvo_ros.benchmarking.tables import Cell, Table

STYLE = """\
:root { color-scheme: light dark; --ink: #1b1b1b; --paper: #ffffff; --line: #d0d0d0;
        --quiet: #5a5a5a; --best: #ffc9c4; --second: #ffe3bd; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e6e6; --paper: #161616; --line: #444444; --quiet: #a8a8a8;
          --best: #7d2a24; --second: #6b4a14; }
}
body { margin: 0 auto; padding: 1rem; max-width: 80rem; color: var(--ink);
       background: var(--paper); font: 1rem/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin: 2.5rem 0 0.5rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
thead tr, tbody tr:last-child { border-bottom: 1px solid var(--line); }
th, td { padding: 0.25rem 0.6rem; text-align: right; white-space: nowrap; }
th:first-child { position: sticky; left: 0; background: var(--paper); text-align: left; }
.best { background: var(--best); font-weight: 700; }
.second { background: var(--second); text-decoration: underline; }
.notes { margin: 0.5rem 0; padding: 0; list-style: none; color: var(--quiet); font-size: 0.85rem; }
.key span { padding: 0.1rem 0.4rem; }
figure { margin: 2.5rem 0 0; } figcaption { font-weight: 700; margin-bottom: 0.5rem; }
img { max-width: max(100%, 40rem); height: auto; background: #ffffff; }
"""
HEAD = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
<h1>{title}</h1>
<p class="key"><span class="best">best</span> <span class="second">second best</span></p>
"""
TAIL = '</body>\n</html>\n'


def write_page(path: Path, title: str, tables: Sequence[Table], pictures: Sequence[Path]) -> None:
    """Write tables and pictures (PNG) into one page; replaces an earlier one."""
    with replaced(path) as draft, draft.open('w', encoding='utf-8') as file:
        file.write(HEAD.format(title=escape(title), style=STYLE))
        for table in tables:
            file.writelines(_table(table))
        for picture in pictures:
            file.writelines(_picture(picture))
        file.write(TAIL)


def _table(table: Table) -> Iterator[str]:
    """Yield the HTML of a table; the first column names the rows."""
    yield f'<h2>{escape(table.title)}</h2>\n<div class="wide"><table>\n<thead><tr>'
    for name in table.head:
        yield f'<th scope="col">{escape(name)}</th>'
    yield '</tr></thead>\n<tbody>\n'
    for first, *others in table.rows:
        cells = ''.join(map(_cell, others))
        yield f'<tr><th scope="row">{escape(first.text)}</th>{cells}</tr>\n'
    yield '</tbody>\n</table></div>\n'
    if table.notes:
        notes = ''.join(f'<li>{escape(note)}</li>' for note in table.notes)
        yield f'<ul class="notes">{notes}</ul>\n'


def _cell(cell: Cell) -> str:
    mark = f' class="{cell.mark}"' if cell.mark else ''
    return f'<td{mark}>{escape(cell.text)}</td>'


def _picture(path: Path) -> Iterator[str]:
    """Yield the HTML of a picture, with the picture in it."""
    name = escape(path.stem)
    data = b64encode(path.read_bytes()).decode('ascii')
    yield (f'<figure><figcaption>{name}</figcaption>\n<div class="wide">'
           f'<img alt="{name}" src="data:image/png;base64,{data}"></div></figure>\n')
