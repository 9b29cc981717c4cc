# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.ablation SEQUENCE...``: what each part of the training contributes.

The paper's ablation, for the geometric backbone, and that of our own reward: every row of
config/ablation.yaml changes the recipe, is trained by kfvo_train with several seeds and tested
on other sequences, beside policies without training.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from kfvo_ros import train
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.commands import (
    expand_ranges,
    make_parser,
    parse_names,
    parse_numbers,
    run_command,
)
from kfvo_ros.utils.config import add_arguments, from_arguments, option
from kfvo_ros.utils.files import locked, user_path
from kfvo_ros.utils.signals import raise_if_interrupted

if TYPE_CHECKING:
    from kfvo_ros.training.ablation import TrainingRun

EXAMPLE = """example:
  python -m kfvo_ros.ablation synthetic:0-39 --validation synthetic:40-49 \\
      --test synthetic:1000-1029 --output ablation
"""
CACHE = 'cache'


@dataclass(frozen=True)
class AblationOptions:
    """What is compared, and how."""

    rows: str | None = option(None, 'rows of the table, with commas; default: all of '
                              'config/ablation.yaml')
    seeds: str = option('0,1,2', 'seeds of the trainings of each row')
    steps: int = option(100_000, 'decisions that each training learns from', least=1)
    recipe: str = option('train.yaml', 'what the rows change: a YAML file, or the name of one in '
                         'config/')
    workers: int = option(1, 'processes that step the episodes', least=1, most=256)
    cache: str | None = option(None, f'folder for the encoded sequences; default: {CACHE} in '
                               '--output')
    stop: int | None = option(None, 'frames of each sequence; default: all', least=1)
    resume: bool = option(False, 'go on: what is complete is not trained again')


@dataclass(frozen=True)
class SequenceSplit:
    """Sequences to train on, to choose the best policy by, and to test on."""

    training: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command('kfvo_ablation', _ablate, argv)


def _ablate(argv: list[str]) -> None:
    # The heavy imports come after the arguments were checked: --help answers at once.
    arguments = _parse(argv)
    options, split = from_arguments(AblationOptions, arguments), _split_sequences(arguments)
    seeds = parse_numbers(options.seeds, 'seeds')
    from kfvo_ros.odometry import factory
    from kfvo_ros.training.ablation import PolicyTest, TrainingRun, make_setup, read_ablation_rows
    from kfvo_ros.training.ablation_report import AblationReport
    from kfvo_ros.utils.process import single_threaded
    folder = user_path(arguments.output)
    options = replace(options, cache=options.cache or str(folder / CACHE))
    setup = make_setup(options.recipe, options.stop, user_path(options.cache or ''))
    recipes = read_ablation_rows(setup.recipe, options.steps)
    rows = tuple(recipes) if options.rows is None else parse_names(options.rows, 'rows', recipes)
    with single_threaded(), locked(folder):
        backbone = factory.make_backbone(setup.odometry)
        plans = {row: replace(setup, recipe=recipes[row]).plan(split.training, split.validation,
                                                               backbone) for row in rows}
        runs = [TrainingRun(row, replace(plan, seed=seed), folder)
                for row, plan in plans.items() for seed in seeds]
        for run in runs:
            run.prepare(options.resume)
        test = PolicyTest.load(split.test, setup, backbone)
        report = AblationReport(folder, list(test.reference_results(setup.recipe)))
        for number, run in enumerate(runs, 1):
            print(f'{number} of {len(runs)}: {run.row}, seed {run.seed}', flush=True)
            if run.is_complete():
                print(f'{run.files.output} is complete')
            else:
                _train(run, split, options)
            report.add(test.file_results(run.row, run.seed, run.files.output),
                       run.plan.recipe.reward, run.files.folder)
    print(f'\n{report.table}\n{", ".join(map(str, report.files))}')


def _train(run: TrainingRun, split: SequenceSplit, options: AblationOptions) -> None:
    """Train by kfvo_train, from the start or the last checkpoint."""
    argv = [*split.training, '--validation', *split.validation]
    for name, value in {'recipe': run.recipe_file, 'output': run.files.output, 'seed': run.seed,
                        'workers': options.workers, 'cache': options.cache,
                        'stop': options.stop}.items():
        argv += [f'--{name}', str(value)] if value is not None else []
    if run.files.checkpoint.exists():
        argv.append('--resume')
    run.write_recipe()
    if train.main(argv) != 0:
        raise_if_interrupted('--resume goes on from there')
        raise KfvoError(f'{run.row}, seed {run.seed}: not trained to the end, for the reason '
                        'above; --resume goes on from there')


def _split_sequences(arguments: argparse.Namespace) -> SequenceSplit:
    """Return the sequences; raises KfvoError for a test sequence that is used in training."""
    split = SequenceSplit(*map(expand_ranges, (arguments.sequence, arguments.validation,
                                               arguments.test)))
    for text in split.test:
        if text in (*split.training, *split.validation):
            raise KfvoError(f'{text} is learned from, or chooses the best policy; expected other '
                            'sequences to --test on')
    return split


def _parse(argv: list[str]) -> argparse.Namespace:
    parser = make_parser('kfvo_ablation', __doc__ or '', EXAMPLE)
    parser.add_argument('sequence', nargs='+', help='sequences to learn from, as of kfvo_train')
    parser.add_argument('--validation', nargs='+', required=True, metavar='SEQUENCE',
                        help='sequences by which the best policy of each training is chosen')
    parser.add_argument('--test', nargs='+', required=True, metavar='SEQUENCE',
                        help='sequences of the table')
    parser.add_argument('--output', required=True, help='folder for policies, logs, table and '
                        'curves')
    add_arguments(parser, AblationOptions)
    return parser.parse_args(argv)


if __name__ == '__main__':
    sys.exit(main())
