# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outcomes of faults: what a reader answers, how that is judged, and the table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from kfvo_ros.errors import MAX_LINE

MAX_REASON = 200
"""Characters of a reason in the list of offenders."""


class Outcome(Enum):
    """How a command or reader took a fault."""

    OK = 'ok'
    CLEAR_ERROR = 'clear error'
    TOLD = 'told'
    NO_CHECKSUM = 'no checksum'
    TRACEBACK = 'traceback'
    CRASH = 'crash'
    HANG = 'hang'
    SILENT_LOSS = 'silent loss'


OFFENCES = (Outcome.TRACEBACK, Outcome.CRASH, Outcome.HANG, Outcome.SILENT_LOSS)


@dataclass(frozen=True)
class Answer:
    """What was read: ``units`` frames, rows or tensors, a ``digest`` of them, and ``words`` said.

    ``error`` is the error that the user reads instead, ``traceback`` the unexpected exception.
    """

    units: int = 0
    digest: str = ''
    words: tuple[str, ...] = ()
    error: str | None = None
    traceback: str | None = None


@dataclass(frozen=True)
class Verdict:
    """The outcome of a try and, where it is not OK, the reason in one line."""

    outcome: Outcome
    reason: str = ''

    @property
    def is_offence(self) -> bool:
        """Whether this must not occur."""
        return self.outcome in OFFENCES


@dataclass(frozen=True)
class Result:
    """A try of a kind: its ``label`` in the table and ``number``, the ``damage`` and a verdict.

    ``folder`` holds its input and output, ``note`` is a remark on the kind.
    """

    label: str
    number: int
    verdict: Verdict
    damage: str
    folder: Path
    note: str = ''


def judge(original: Answer, answer: Answer, checked: bool, counted: bool,
          name: str = '') -> Verdict:
    """Return the outcome of reading a damaged input, which an error must `name`.

    ``checked``: its format has checksums that show this damage; ``counted``: the source states
    its number of units. Where neither holds, other values are like any others.
    """
    if answer.traceback is not None:
        return Verdict(Outcome.TRACEBACK, answer.traceback)
    if answer.error is not None:
        return _judge_error(answer.error, name)
    if (answer.units, answer.digest) == (original.units, original.digest):
        return Verdict(Outcome.OK)
    said = [text for text in answer.words if text not in original.words]
    if said:
        return Verdict(Outcome.TOLD, said[0])
    difference = f'{answer.units} of {original.units} units' \
        if answer.units != original.units else 'other values'
    if checked or (counted and answer.units < original.units):
        return Verdict(Outcome.SILENT_LOSS, f'{difference}, without a word')
    return Verdict(Outcome.NO_CHECKSUM, difference)


def _judge_error(error: str, name: str) -> Verdict:
    """Return whether an error is one line that names the input; small files need no memory."""
    lines = error.strip().splitlines() or ['']
    if 'out of memory' in lines[0]:
        return Verdict(Outcome.CRASH, lines[0])
    if len(lines) != 1 or len(lines[0]) > 2 * MAX_LINE or name not in lines[0]:
        return Verdict(Outcome.TRACEBACK, f'expected one line that names {name or "the input"}, '
                                          f'came {error[:MAX_REASON]!r}')
    return Verdict(Outcome.CLEAR_ERROR, lines[0])


@dataclass
class Tally:
    """Numbers of outcomes by kind, in order; ``notes`` are remarks on a kind."""

    counts: dict[str, Counter[Outcome]] = field(default_factory=dict)
    offenders: list[str] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)

    def add(self, kind: str, outcome: Outcome, note: str = '') -> None:
        """Count an outcome."""
        self.counts.setdefault(kind, Counter())[outcome] += 1
        if note:
            self.notes[kind] = note

    @property
    def tried(self) -> int:
        """Number of tries."""
        return sum(counts.total() for counts in self.counts.values())

    @property
    def offences(self) -> int:
        """Number of tracebacks, crashes, hangs and silent losses."""
        return sum(counts[outcome] for counts in self.counts.values() for outcome in OFFENCES)

    def table(self) -> str:
        """Return the table as Markdown."""
        rows: list[Iterable[Any]] = [('kind', 'tried', *(each.value for each in Outcome))]
        for kind, counts in self.counts.items():
            name = f'{kind} ({self.notes[kind]})' if kind in self.notes else kind
            rows.append((name, counts.total(), *(counts[each] for each in Outcome)))
        total = sum(self.counts.values(), Counter[Outcome]())
        rows.append(('all', total.total(), *(total[each] for each in Outcome)))
        cells = [[str(cell) for cell in row] for row in rows]
        widths = [max(map(len, column)) for column in zip(*cells)]
        lines = ['| ' + ' | '.join(
            cell.rjust(width) if index else cell.ljust(width)
            for index, (cell, width) in enumerate(zip(row, widths))) + ' |' for row in cells]
        rule = '|' + '|'.join('-' * (width + 1) + (':' if index else '-')
                              for index, width in enumerate(widths)) + '|'
        return '\n'.join([lines[0], rule, *lines[1:]])
