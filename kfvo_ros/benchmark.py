# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.benchmark SEQUENCE... --output DIR``: the paper's tables.

Every method on every sequence with every seed, each as `python -m kfvo_ros.run` in a process of
its own; then the tables of the paper, with its own numbers beside those measured here.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.keyframes import POLICIES
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.utils.commands import make_parser, parse_names, parse_numbers, run_command
from kfvo_ros.utils.config import add_arguments, from_arguments, option

if TYPE_CHECKING:
    from kfvo_ros.evaluation.plan import BenchmarkPlan
    from kfvo_ros.evaluation.records import Row
    from kfvo_ros.evaluation.runner import Run
    from kfvo_ros.evaluation.scoring import Evaluator


EXAMPLES = """examples:
  python -m kfvo_ros.benchmark synthetic:0-4:smooth --output results
  python -m kfvo_ros.benchmark EuRoC/* --methods every,optical_flow,survival,learned \\
      --policy policy.safetensors --seeds 0,1,2 --output results
  python -m kfvo_ros.benchmark EuRoC/* --backbone vggt --scale none --output results
"""
RESULTS = 'results.csv'
ANSWERED = ('keyframes', 'seed')
"""Options of an odometry that methods and seeds stand for."""


@dataclass(frozen=True)
class BenchmarkOptions:
    """What is compared, and how."""

    methods: str | None = option(None, f'keyframe policies out of {",".join(POLICIES)}; default: '
                                 'all, learned if a policy is named or comes along')
    seeds: str = option('0', 'seeds of each method on each sequence, such as 0,1,2')
    jobs: int = option(1, 'runs side by side; they slow each other down, and the table of times '
                       'says how many there were', least=1, most=256)
    resume: bool = option(False, 'go on: what is finished is not run again')
    overwrite: bool = option(False, 'begin anew where there are results')
    no_pictures: bool = option(False, 'draw nothing, which needs no matplotlib')


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command('kfvo_benchmark', _benchmark, argv)


def _benchmark(argv: list[str]) -> None:
    # The heavy imports come after the arguments were checked: --help answers at once.
    arguments = _parse(argv)
    options = from_arguments(BenchmarkOptions, arguments)
    if not options.no_pictures:
        import matplotlib  # noqa: F401  what is missing is told before hours of runs
    from kfvo_ros.evaluation.scoring import Evaluator
    from kfvo_ros.evaluation.sequences import open_benchmark_sequences
    plan = _plan(arguments, options)
    _check(plan.folder, options)
    runs = plan.runs(open_benchmark_sequences(plan.sequences, plan.reading))
    finished = [run for run in runs if options.resume and run.is_finished()]
    examiner = Evaluator(plan.reading)
    rows = _go_through(plan, runs, finished, examiner)
    _report(plan, runs, rows, examiner, not options.no_pictures)


def _plan(arguments: argparse.Namespace, options: BenchmarkOptions) -> BenchmarkPlan:
    """Return what is asked for; raises KfvoError for what cannot be."""
    from kfvo_ros.evaluation.plan import BenchmarkPlan, default_methods, fitting_policy
    from kfvo_ros.utils.commands import expand_ranges
    odometry = from_arguments(OdometryOptions, arguments)
    methods = parse_names(options.methods, 'methods', POLICIES) if options.methods \
        else default_methods(odometry)
    return BenchmarkPlan(tuple(arguments.sequence), expand_ranges(arguments.sequence), methods,
                         parse_numbers(options.seeds, 'seeds'), odometry,
                         from_arguments(VggtOptions, arguments), from_arguments(SequenceOptions, arguments),
                         options.jobs, Path(arguments.output).expanduser(),
                         fitting_policy(methods, odometry))


def _check(folder: Path, options: BenchmarkOptions) -> None:
    """Make the folder; raises KfvoError where there are results nobody wants to lose."""
    from kfvo_ros.evaluation.plan import RUNS
    taken = [name for name in (RESULTS, RUNS) if (folder / name).exists()]
    if taken and not (options.resume or options.overwrite):
        raise KfvoError(f'{folder} already holds {", ".join(taken)}; choose another --output, or '
                        'add --resume to go on or --overwrite to begin anew')
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise KfvoError(f'cannot write to {folder}: {reason_of(error)}') from error


def _go_through(plan: BenchmarkPlan, runs: Sequence[Run], finished: Sequence[Run],
                examiner: Evaluator) -> list[Row]:
    """Run what is not finished; return all rows in order, which results.csv has as they come."""
    from tqdm import tqdm

    from kfvo_ros.evaluation.records import append_rows, in_order, write_rows
    from kfvo_ros.evaluation.runner import run_in_parallel
    path, done = plan.folder / RESULTS, {run.folder for run in finished}
    rows = [row for run in finished for row in examiner.rows(run, None)]
    write_rows(path, rows)
    with tqdm(total=len(runs), initial=len(finished), unit='run') as bar:
        def ended(run: Run, problem: str | None) -> None:
            """Take in what came of a run, at once."""
            new = examiner.rows(run, problem)
            append_rows(path, new)
            rows.extend(new)
            bar.update()
            if problem is not None:
                bar.write(f'{run.subject.name}, {run.method}, seed {run.seed}: {problem}',
                          file=sys.stderr)

        try:
            run_in_parallel([run for run in runs if run.folder not in done], plan.jobs, ended)
        except KeyboardInterrupt as interruption:
            raise KfvoError(f'interrupted after {bar.n} of {len(runs)} runs, which are in {path}; '
                            '--resume goes on') from interruption
    rows = in_order(rows, tuple(dict.fromkeys(run.subject.name for run in runs)), plan.methods)
    write_rows(path, rows)
    return rows


def _report(plan: BenchmarkPlan, runs: Sequence[Run], rows: Sequence[Row], examiner: Evaluator,
            with_pictures: bool) -> None:
    """Write the pages, and say what came of it; raises KfvoError where all failed."""
    from kfvo_ros.evaluation.records import FAILED
    from kfvo_ros.evaluation.render import markdown
    from kfvo_ros.evaluation.report import About, make_tables, write_report
    pictures: tuple[Path, ...] = ()
    if with_pictures:
        from kfvo_ros.evaluation.report import draw
        pictures = draw(plan.folder, runs, examiner)
    about = About(plan.command, __version__, plan.reading.stop, plan.policy_name)
    tables = make_tables(rows, about)
    write_report(plan.folder, tables, pictures, about)
    failed = [row for row in rows if row.status == FAILED]
    if len(failed) == len(runs):
        raise KfvoError(f'all runs failed, the first because: {failed[0].problem}')
    print()
    for table in tables:
        if table.total:
            print(markdown(table))
    print(f'{len(runs) - len(failed)} of {len(runs)} runs finished; '
          f'{plan.folder}/results.csv, .md, .tex and .html')


def _parse(argv: list[str]) -> argparse.Namespace:
    parser = make_parser('kfvo_benchmark', __doc__ or '', EXAMPLES)
    parser.add_argument('sequence', nargs='+', help='dataset folders or bags, or '
                        'synthetic:A-B[:smooth|fast|mixed|street]')
    parser.add_argument('--output', required=True, help='folder for results.csv, results.md, '
                        'results.tex, results.html and the pictures; the files of each run come '
                        'into its runs/SEQUENCE/METHOD/SEED')
    add_arguments(parser, BenchmarkOptions)
    add_arguments(parser, OdometryOptions, ANSWERED)
    add_arguments(parser, VggtOptions)
    add_arguments(parser, SequenceOptions)
    arguments = parser.parse_args(argv)
    if arguments.resume and arguments.overwrite:
        parser.error('expected --resume or --overwrite, both came')
    return arguments


if __name__ == '__main__':
    sys.exit(main())
