# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.benchmark SEQUENCE... --output DIR``: the paper's tables.

Runs every method on every sequence with every seed, each as `python -m kfvo_ros.run` in a process
of its own; then writes the paper's tables, with its numbers beside those measured here.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes import POLICIES
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.utils.commands import make_parser, parse_names, parse_numbers, run_command
from kfvo_ros.utils.config import add_arguments, from_arguments, option
from kfvo_ros.utils.files import locked, user_path
from kfvo_ros.utils.progress import progress_bar
from kfvo_ros.utils.signals import Interrupted

if TYPE_CHECKING:
    from kfvo_ros.evaluation.plan import BenchmarkPlan
    from kfvo_ros.evaluation.records import Evaluator, Row
    from kfvo_ros.evaluation.runner import Run

EXAMPLES = """examples:
  python -m kfvo_ros.benchmark synthetic:0-4:smooth --output results
  python -m kfvo_ros.benchmark EuRoC/* --methods every,optical_flow,survival,learned \\
      --policy policy.safetensors --seeds 0,1,2 --output results
  python -m kfvo_ros.benchmark EuRoC/* --backbone vggt --scale none --output results
"""
RESULTS = 'results.csv'
PLANNED = ('keyframes', 'seed')
"""Odometry options that follow from --methods and --seeds."""


@dataclass(frozen=True)
class BenchmarkOptions:
    """Benchmark options."""

    methods: str | None = option(None, f'keyframe policies out of {",".join(POLICIES)}; default: '
                                 'all but parallax, learned if a policy is named or comes with '
                                 'the backbone')
    seeds: str = option('0', 'seeds of each method on each sequence, such as 0,1,2')
    jobs: int = option(1, 'runs side by side; they slow each other down, and the table of times '
                       'says how many there were', least=1, most=256)
    resume: bool = option(False, 'continue: skip the runs that are finished')
    overwrite: bool = option(False, 'replace existing results')
    no_pictures: bool = option(False, 'write no plots; needs no matplotlib')


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command('kfvo_benchmark', _benchmark, argv)


def _benchmark(argv: list[str]) -> None:
    # The heavy imports come after the arguments were checked: --help answers at once.
    arguments = _parse(argv)
    options = from_arguments(BenchmarkOptions, arguments)
    if not options.no_pictures:
        import matplotlib  # noqa: F401  a missing module fails here, not after hours of runs
    from kfvo_ros.evaluation.plan import open_benchmark_sequences
    from kfvo_ros.evaluation.records import Evaluator
    plan = _make_plan(arguments, options)
    with locked(plan.folder):
        _check_folder(plan.folder, options)
        runs = plan.runs(open_benchmark_sequences(plan.sequences, plan.sequence_options))
        finished = [run for run in runs if options.resume and run.is_finished()]
        evaluator = Evaluator(plan.sequence_options)
        rows = _execute(plan, runs, finished, evaluator)
        _report(plan, runs, rows, evaluator, with_plots=not options.no_pictures)


def _make_plan(arguments: argparse.Namespace, options: BenchmarkOptions) -> BenchmarkPlan:
    """Return the plan; raises KfvoError for methods, seeds or a policy that are not valid."""
    from kfvo_ros.evaluation.plan import BenchmarkPlan, check_policy, default_methods
    from kfvo_ros.utils.commands import expand_ranges
    odometry = from_arguments(OdometryOptions, arguments)
    methods = parse_names(options.methods, 'methods', POLICIES) if options.methods \
        else default_methods(odometry)
    return BenchmarkPlan(
        sequence_arguments=tuple(arguments.sequence),
        sequences=expand_ranges(arguments.sequence),
        methods=methods,
        seeds=parse_numbers(options.seeds, 'seeds'),
        odometry=odometry,
        vggt=from_arguments(VggtOptions, arguments),
        sequence_options=from_arguments(SequenceOptions, arguments),
        jobs=options.jobs,
        folder=user_path(arguments.output),
        policy_sha256=check_policy(methods, odometry))


def _check_folder(folder: Path, options: BenchmarkOptions) -> None:
    """Raise KfvoError where results would be lost."""
    from kfvo_ros.evaluation.plan import RUNS
    existing = [name for name in (RESULTS, RUNS) if (folder / name).exists()]
    if existing and not (options.resume or options.overwrite):
        raise KfvoError(f'{folder} already holds {", ".join(existing)}; choose another --output, '
                        'or add --resume to continue or --overwrite to replace them')


def _execute(plan: BenchmarkPlan, runs: Sequence[Run], finished: Sequence[Run],
             evaluator: Evaluator) -> list[Row]:
    """Execute all but the finished runs and return all rows in order.

    results.csv gets each row as its run ends.
    """
    from kfvo_ros.evaluation.records import append_rows, sort_rows, write_rows
    from kfvo_ros.evaluation.runner import run_in_parallel
    path, done = plan.folder / RESULTS, {run.folder for run in finished}
    rows = [row for run in finished for row in evaluator.rows(run, None)]
    write_rows(path, rows)
    with progress_bar(len(runs), 'run', initial=len(finished)) as bar:
        def on_end(run: Run, problem: str | None) -> None:
            """Append the rows of a run, and print its problem."""
            new = evaluator.rows(run, problem)
            append_rows(path, new)
            rows.extend(new)
            bar.update()
            if problem is not None:
                bar.write(f'{run.sequence.name}, {run.method}, seed {run.seed}: {problem}',
                          file=sys.stderr)

        try:
            run_in_parallel([run for run in runs if run.folder not in done], plan.jobs, on_end)
        except Interrupted:
            raise Interrupted(f'{bar.n} of {len(runs)} runs are in {path}; --resume continues'
                              ) from None
    rows = sort_rows(rows, tuple(dict.fromkeys(run.sequence.name for run in runs)), plan.methods)
    write_rows(path, rows)
    return rows


def _report(plan: BenchmarkPlan, runs: Sequence[Run], rows: Sequence[Row], evaluator: Evaluator,
            with_plots: bool) -> None:
    """Write the report and print the ATE tables; raises KfvoError where all runs failed."""
    from kfvo_ros.evaluation.records import FAILED
    from kfvo_ros.evaluation.render import markdown
    from kfvo_ros.evaluation.report import Provenance, make_tables, plot_runs, write_report
    figures = plot_runs(plan.folder, runs, evaluator) if with_plots else ()
    provenance = Provenance(plan.command, __version__, plan.sequence_options.stop,
                            plan.policy_description)
    tables = make_tables(rows, provenance)
    write_report(plan.folder, tables, figures, provenance)
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
                        'results.tex, results.html and the plots; the files of each run are in '
                        'its runs/SEQUENCE/METHOD/SEED')
    add_arguments(parser, BenchmarkOptions)
    add_arguments(parser, OdometryOptions, PLANNED)
    add_arguments(parser, VggtOptions)
    add_arguments(parser, SequenceOptions)
    arguments = parser.parse_args(argv)
    if arguments.resume and arguments.overwrite:
        parser.error('expected --resume or --overwrite, both came')
    return arguments


if __name__ == '__main__':
    sys.exit(main())
