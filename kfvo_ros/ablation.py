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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
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

if TYPE_CHECKING:
    from kfvo_ros.backbones.base import Backbone
    from kfvo_ros.training.ablation import PolicyTest, TrainingRun
    from kfvo_ros.training.ablation_report import PolicyResult
    from kfvo_ros.training.plan import TrainingSetup

EXAMPLE = """example:
  python -m kfvo_ros.ablation synthetic:0-39 --validation synthetic:40-49 \\
      --test synthetic:1000-1029 --output ablation
"""
CSV, MARKDOWN, CURVES, CACHE = 'ablation.csv', 'ablation.md', 'curves.png', 'cache'


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
    import matplotlib  # noqa: F401  a missing package is an error before hours of training
    import stable_baselines3  # noqa: F401
    import tensorboard  # noqa: F401

    from kfvo_ros.odometry import factory
    from kfvo_ros.utils.process import single_threaded
    folder = Path(arguments.output).expanduser()
    options = replace(options, cache=options.cache or str(folder / CACHE))
    setup = _make_setup(options)
    with single_threaded():
        backbone = factory.make_backbone(setup.odometry)
        runs = list(_plan_runs(setup, options, split, seeds, folder, backbone))
        for run in runs:
            run.prepare(options.resume)
        test = _make_test(setup, split.test, backbone)
        references = list(test.reference_results(setup.recipe))
        results: list[PolicyResult] = []
        for number, run in enumerate(runs, 1):
            print(f'{number} of {len(runs)}: {run.row}, seed {run.seed}', flush=True)
            results += _train_and_test(run, split, options, test)
            _write_report(runs[:number], [*results, *references])
    print(f'\n{(folder / MARKDOWN).read_text(encoding="utf-8")}\n'
          f'{folder / MARKDOWN}, {folder / CSV}, {folder / CURVES}')


def _make_setup(options: AblationOptions) -> TrainingSetup:
    """Return what the test and all trainings have in common; raises KfvoError."""
    from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
    from kfvo_ros.training.config import read_training_config
    from kfvo_ros.training.plan import TrainingSetup
    recipe = read_training_config(options.recipe)
    odometry = OdometryOptions(scale_rule=recipe.scale)
    return TrainingSetup(odometry.seed, recipe, odometry, SequenceOptions(stop=options.stop),
                         VggtOptions(), Path(options.cache or '').expanduser())


def _plan_runs(setup: TrainingSetup, options: AblationOptions, split: SequenceSplit,
               seeds: Sequence[int], folder: Path, backbone: Backbone) -> Iterator[TrainingRun]:
    """Yield the trainings of all rows and seeds; raises KfvoError."""
    from kfvo_ros.training.ablation import TrainingRun, read_ablation_rows
    recipes = read_ablation_rows(setup.recipe, options.steps)
    rows = tuple(recipes) if options.rows is None else parse_names(options.rows, 'rows', recipes)
    for row in rows:
        plan = replace(setup, recipe=recipes[row]).plan(split.training, split.validation,
                                                        backbone)
        for seed in seeds:
            yield TrainingRun(row, replace(plan, seed=seed), folder)


def _make_test(setup: TrainingSetup, sequences: tuple[str, ...], backbone: Backbone) -> PolicyTest:
    """Return the test, with its sequences encoded as in use; raises KfvoError."""
    from tqdm import tqdm

    from kfvo_ros.odometry import factory
    from kfvo_ros.training.ablation import PolicyTest
    from kfvo_ros.training.evaluation import PolicyEvaluation
    cache = setup.sequence_cache(backbone)
    encoded = [cache.sequence(text) for text in tqdm(sequences, unit='sequence', desc='test')]
    signature = factory.signature_of(setup.odometry, backbone)
    return PolicyTest(sequences, PolicyEvaluation(encoded, backbone, signature), setup.odometry)


def _train_and_test(run: TrainingRun, split: SequenceSplit, options: AblationOptions,
                    test: PolicyTest) -> list[PolicyResult]:
    """Return the results of a training, which is trained first unless it is complete."""
    from kfvo_ros.keyframes.learned import read_policy
    if run.is_complete():
        print(f'{run.files.output} is complete')
    else:
        _train(run, split, options)
    policy = read_policy(run.files.output).policy(test.evaluation.signature)
    return test.results(run.row, run.seed, policy)


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
        raise KfvoError(f'{run.row}, seed {run.seed}: not trained to the end, for the reason '
                        'above; --resume goes on from there')


def _write_report(runs: Sequence[TrainingRun], results: Sequence[PolicyResult]) -> None:
    """Write table and curves of the trainings so far."""
    from kfvo_ros.training.ablation_report import (
        plot_curves,
        read_curve,
        write_csv,
        write_markdown,
    )
    folder = runs[0].folder
    write_csv(folder / CSV, results)
    write_markdown(folder / MARKDOWN, results)
    plot_curves(folder / CURVES, [
        read_curve(run.row, run.plan.recipe.reward, run.files.folder) for run in runs])


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
