# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables as LaTeX, as the paper sets them: the best of a column red, the second best orange."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from kfvo_ros.benchmarking.tables import NO, YES, Cell, Table

HEAD = r"""% \input this file; it needs \usepackage{booktabs,graphicx,pifont,xcolor}
"""
FORMS = {'best': r'\colorbox{{red!50}}{{{}}}', 'second': r'\colorbox{{orange!50}}{{{}}}',
         None: '{}'}
SIGNS = {'\\': r'\textbackslash{}', '&': r'\&', '%': r'\%', '$': r'\$', '#': r'\#', '_': r'\_',
         '{': r'\{', '}': r'\}', '~': r'\textasciitilde{}', '^': r'\textasciicircum{}',
         '[': '{[}', ']': '{]}', '<': r'\textless{}', '>': r'\textgreater{}', '–': '--',
         '†': r'$\dagger$', YES: r'\textcolor{green}{\ding{51}}',
         NO: r'\textcolor{red}{\ding{55}}'}
FITTED = r'\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%'
"""As wide as it is, but no wider than the page."""


def latex(tables: Iterable[Table]) -> str:
    r"""Return a file to ``\input``, one float for each table."""
    return HEAD + ''.join('\n' + '\n'.join(_float(table)) + '\n' for table in tables)


def escaped(text: str) -> str:
    """Return what LaTeX prints as this text."""
    return ''.join(SIGNS.get(sign, sign) for sign in text)


def _float(table: Table) -> Iterator[str]:
    yield r'\begin{table*}[t]'
    yield r'\centering'
    yield rf'\caption{{{escaped(table.title)}.}}'
    yield FITTED
    yield rf'\begin{{tabular}}{{{_columns(table)}}}'
    yield r'\toprule'
    yield _line(rf'\textbf{{{escaped(name)}}}' for name in table.head)
    yield r'\midrule'
    for index, row in enumerate(table.rows):
        if index in table.rules:
            yield r'\midrule'
        yield _line(map(_cell, row))
    yield r'\bottomrule'
    yield r'\end{tabular}}'
    for note in table.notes:
        yield rf'\par\noindent{{\footnotesize {escaped(note)}\par}}'
    yield r'\end{table*}'


def _columns(table: Table) -> str:
    """Return the columns' alignment, with lines between kinds of columns."""
    numbers = len(table.head) - table.words - table.total
    return '|'.join(filter(None, ('l', 'c' * (table.words - 1), 'c' * numbers,
                                  'c' * table.total)))


def _cell(cell: Cell) -> str:
    return FORMS[cell.mark].format(escaped(cell.text))


def _line(texts: Iterable[str]) -> str:
    return ' & '.join(texts) + r' \\'
