# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables, and their rendering as Markdown, LaTeX and HTML."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Literal

from kfvo_ros.utils.files import atomic_write

Mark = Literal['best', 'second']
YES, NO, NONE = '✓', '✗', '–'
MARKDOWN_MARKS = {'best': '**{}**', 'second': '<u>{}</u>', None: '{}'}
MARKDOWN_SPECIAL = re.compile(r'([\\`*<>|])')
LATEX_HEAD = r"""% \input this file; it needs \usepackage{booktabs,graphicx,pifont,xcolor}
"""
LATEX_MARKS = {'best': r'\colorbox{{red!50}}{{{}}}', 'second': r'\colorbox{{orange!50}}{{{}}}',
               None: '{}'}
LATEX_ESCAPES = {
    '\\': r'\textbackslash{}', '&': r'\&', '%': r'\%', '$': r'\$', '#': r'\#', '_': r'\_',
    '{': r'\{', '}': r'\}', '~': r'\textasciitilde{}', '^': r'\textasciicircum{}', '[': '{[}',
    ']': '{]}', '<': r'\textless{}', '>': r'\textgreater{}', '–': '--', '†': r'$\dagger$',
    YES: r'\textcolor{green}{\ding{51}}', NO: r'\textcolor{red}{\ding{55}}'}
LATEX_RESIZEBOX = r'\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%'
"""Natural width, but at most the width of the page."""
HTML_STYLE = """\
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
HTML_HEAD = """\
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
HTML_TAIL = '</body>\n</html>\n'


@dataclass(frozen=True)
class Cell:
    """A plain text, and its mark if it is the best or second best of its column."""

    text: str
    mark: Mark | None = None


@dataclass(frozen=True)
class Table:
    """``head`` (columns), ``rows`` of as many cells, and ``notes`` below the table.

    The first ``words`` columns hold words, the others numbers, the last of them a summary of the
    others if ``total``; ``rules`` are the rows above which a line is drawn.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()
    words: int = 1
    total: bool = False
    rules: tuple[int, ...] = ()


def markdown(table: Table) -> str:
    """Return a table in Markdown, under a heading and with its notes below."""
    return '\n'.join((f'## {escape_markdown(table.title)}', '', *_markdown_grid(table), '',
                      *(f'{escape_markdown(note)}  ' for note in table.notes), ''))


def escape_markdown(text: str) -> str:
    """Return the Markdown of a plain text."""
    return MARKDOWN_SPECIAL.sub(r'\\\1', text)


def _markdown_grid(table: Table) -> Iterator[str]:
    yield _markdown_row(map(escape_markdown, table.head))
    yield _markdown_row('---' if index < table.words else '---:'
                        for index in range(len(table.head)))
    for row in table.rows:
        yield _markdown_row(map(_markdown_cell, row))


def _markdown_cell(cell: Cell) -> str:
    return MARKDOWN_MARKS[cell.mark].format(escape_markdown(cell.text))


def _markdown_row(texts: Iterator[str]) -> str:
    return f'| {" | ".join(texts)} |'


def latex(tables: Iterable[Table]) -> str:
    r"""Return a file to ``\input``, one float for each table."""
    return LATEX_HEAD + ''.join('\n' + '\n'.join(_float(table)) + '\n' for table in tables)


def escape_latex(text: str) -> str:
    """Return the LaTeX of a plain text."""
    return ''.join(LATEX_ESCAPES.get(sign, sign) for sign in text)


def _float(table: Table) -> Iterator[str]:
    yield r'\begin{table*}[t]'
    yield r'\centering'
    yield rf'\caption{{{escape_latex(table.title)}.}}'
    yield LATEX_RESIZEBOX
    yield rf'\begin{{tabular}}{{{_columns(table)}}}'
    yield r'\toprule'
    yield _latex_row(rf'\textbf{{{escape_latex(name)}}}' for name in table.head)
    yield r'\midrule'
    for index, row in enumerate(table.rows):
        if index in table.rules:
            yield r'\midrule'
        yield _latex_row(map(_latex_cell, row))
    yield r'\bottomrule'
    yield r'\end{tabular}}'
    for note in table.notes:
        yield rf'\par\noindent{{\footnotesize {escape_latex(note)}\par}}'
    yield r'\end{table*}'


def _columns(table: Table) -> str:
    """Return the alignment of the columns, with lines between kinds of columns."""
    numbers = len(table.head) - table.words - table.total
    return '|'.join(filter(None, ('l', 'c' * (table.words - 1), 'c' * numbers,
                                  'c' * table.total)))


def _latex_cell(cell: Cell) -> str:
    return LATEX_MARKS[cell.mark].format(escape_latex(cell.text))


def _latex_row(texts: Iterable[str]) -> str:
    return ' & '.join(texts) + r' \\'


def write_page(path: Path, title: str, tables: Sequence[Table], figures: Sequence[Path]) -> None:
    """Write tables and figures (PNG) into one HTML page, in place of an earlier one."""
    with atomic_write(path) as draft, draft.open('w', encoding='utf-8',
                                                 errors='backslashreplace') as file:
        file.write(HTML_HEAD.format(title=escape(title), style=HTML_STYLE))
        for table in tables:
            file.writelines(_html_table(table))
        for figure in figures:
            file.writelines(_html_figure(figure))
        file.write(HTML_TAIL)


def _html_table(table: Table) -> Iterator[str]:
    """Yield the HTML of a table; the first column names the rows."""
    yield f'<h2>{escape(table.title)}</h2>\n<div class="wide"><table>\n<thead><tr>'
    for name in table.head:
        yield f'<th scope="col">{escape(name)}</th>'
    yield '</tr></thead>\n<tbody>\n'
    for first, *others in table.rows:
        cells = ''.join(map(_html_cell, others))
        yield f'<tr><th scope="row">{escape(first.text)}</th>{cells}</tr>\n'
    yield '</tbody>\n</table></div>\n'
    if table.notes:
        notes = ''.join(f'<li>{escape(note)}</li>' for note in table.notes)
        yield f'<ul class="notes">{notes}</ul>\n'


def _html_cell(cell: Cell) -> str:
    mark = f' class="{cell.mark}"' if cell.mark else ''
    return f'<td{mark}>{escape(cell.text)}</td>'


def _html_figure(path: Path) -> Iterator[str]:
    """Yield the HTML of a figure (PNG), with its data embedded."""
    name = escape(path.stem)
    data = b64encode(path.read_bytes()).decode('ascii')
    yield (f'<figure><figcaption>{name}</figcaption>\n<div class="wide">'
           f'<img alt="{name}" src="data:image/png;base64,{data}"></div></figure>\n')
