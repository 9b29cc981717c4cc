# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.faults``: damaged inputs, signals, kills and full disks, in one table."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from benchmarks.faults.files import KINDS, FileFaults, Try, slug
from benchmarks.faults.interruptions import FAULTS, ProcessFaults, ProcessTry
from benchmarks.faults.outcomes import Tally
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.progress import progress_bar
from kfvo_ros.utils.signals import Interrupted, raise_if_interrupted

COMMAND = 'benchmarks.faults'
EXAMPLES = """examples:
  python -m benchmarks.faults
  python -m benchmarks.faults --only mcap,png --tries 50
  python -m benchmarks.faults --only signal,kill --seed 1
  python -m benchmarks.faults --only mcap_zstd --number 17
"""
MAX_JOBS = 4


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command(COMMAND, _run, argv)


def _run(argv: list[str]) -> None:
    arguments = _parse(argv)
    files, processes = _choose(arguments)
    tally = Tally()
    with tempfile.TemporaryDirectory(prefix='faults') as work:
        try:
            file_faults = FileFaults(Path(work), arguments.seed, arguments.jobs)
            _collect(file_faults.outcomes(files), len(files), tally, arguments)
            process_faults = ProcessFaults(Path(work), arguments.seed, arguments.jobs)
            _collect(process_faults.outcomes(processes), len(processes), tally, arguments)
        except Interrupted:
            raise Interrupted(f'{tally.tried} of {len(files) + len(processes)} tries are in the '
                              'table') from None
        finally:
            print('\n'.join([tally.table(), *tally.offenders]), flush=True)
    if tally.offences:
        raise KfvoError(f'{tally.offences} offences; their inputs are in {arguments.output}')


def _parse(argv: list[str]) -> argparse.Namespace:
    names = dict.fromkeys(slug(name) for name in (
        *(kind.name for kind in KINDS),
        *(ProcessTry(fault, command, 0).label for fault, command, _ in FAULTS)))
    parser = make_parser(COMMAND, f'{__doc__}\n\nKinds:\n  ' + '\n  '.join(names), EXAMPLES)
    parser.add_argument('--only', default='', help='kinds, or beginnings of their names, with '
                        'commas in between (default: all)')
    parser.add_argument('--tries', type=int, help='tries of each kind (default: those of '
                        'docs/faults.md)')
    parser.add_argument('--seed', type=int, default=0, help='seed of the damage and of the '
                        'moments (default: %(default)s)')
    parser.add_argument('--number', type=int, help='only the try of this number')
    parser.add_argument('--jobs', type=int, default=min(os.cpu_count() or 1, MAX_JOBS),
                        help='tries side by side (default: %(default)s)')
    parser.add_argument('--output', default='faults', help='folder for inputs that were not '
                        'taken well (default: %(default)s)')
    return parser.parse_args(argv)


def _choose(arguments: argparse.Namespace) -> tuple[list[Try], list[ProcessTry]]:
    """Return the tries that the arguments select; raises KfvoError where there are none."""
    prefixes = tuple(arguments.only.split(','))

    def numbers(name: str, tries: int) -> Sequence[int]:
        if not slug(name).startswith(prefixes):
            return ()
        count = tries if arguments.tries is None else arguments.tries
        return range(count) if arguments.number is None else (arguments.number,)

    files = [Try(kind, number) for kind in KINDS for number in numbers(kind.name, kind.tries)]
    processes = [ProcessTry(fault, command, number) for fault, command, tries in FAULTS
                 for number in numbers(ProcessTry(fault, command, 0).label, tries)]
    if not files and not processes:
        raise KfvoError(f'expected kinds with --only, came {arguments.only!r}; --help lists them')
    return files, processes


def _collect(outcomes: Iterable[Any], count: int, tally: Tally,
             arguments: argparse.Namespace) -> None:
    """Count the outcomes; keep the input of each offence, with a line that repeats it."""
    if count == 0:
        return
    with closing(outcomes) as results, progress_bar(count, 'try') as bar:  # type: ignore
        for each in results:
            raise_if_interrupted()
            tally.add(each.label, each.verdict.outcome, each.note)
            if each.verdict.is_offence:
                kept = Path(arguments.output, f'{slug(each.label)}_{arguments.seed}_{each.number}')
                shutil.rmtree(kept, ignore_errors=True)
                shutil.copytree(each.folder, kept)
                repeat = (f'python -m {COMMAND} --only {slug(each.label)} --seed '
                          f'{arguments.seed} --number {each.number}')
                line = (f'{each.verdict.outcome.value}: {each.label}: {each.damage}: '
                        f'{each.verdict.reason}')
                (kept / 'fault.txt').write_text(f'{line}\n{repeat}\n', encoding='utf-8')
                tally.offenders.append(f'{line}\n  {kept}; {repeat}')
            shutil.rmtree(each.folder, ignore_errors=True)
            bar.update()


if __name__ == '__main__':
    sys.exit(main())
