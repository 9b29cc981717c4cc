# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.ablation SEQUENCE...``: what each part of the learning is good for.

The paper's ablation, for the geometric backbone, and that of our own reward: every row is a
recipe of its own, trained by kfvo_train with several seeds and tested on sequences that nobody
learned from, beside policies that learned nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from kfvo_ros import train
from kfvo_ros.errors import KfvoError
from kfvo_ros.training.ablation import ROWS, row_config
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
    from kfvo_ros.training.ablation import PolicyResult, TrainingRun
    from kfvo_ros.training.config import TrainingConfig
    from kfvo_ros.training.evaluation import PolicyEvaluation
    from kfvo_ros.training.plan import TrainingSetup


EXAMPLE = """example:
  python -m kfvo_ros.ablation synthetic:0-39 --validation synthetic:40-49 \\
      --test synthetic:1000-1029 --output ablation
"""
TABLE, PAGE, CURVES, CACHE = 'ablation.csv', 'ablation.md', 'curves.png', 'cache'


@dataclass(frozen=True)
class AblationOptions:
    """What is compared, and how."""

    rows: str = option(','.join(ROWS), 'rows of the table')
    seeds: str = option('0,1,2', 'seeds of the trainings of each row')
    steps: int = option(100_000, 'decisions that each training learns from', least=1)
    recipe: str = option('train.yaml', 'what the rows change: a YAML file, or the name of one in '
                         'config/')
    workers: int = option(1, 'processes that drive the episodes', least=1, most=256)
    cache: str | None = option(None, 'folder that keeps what the backbone made of the sequences; '
                               f'default: {CACHE} in --output')
    stop: int | None = option(None, 'of each sequence so many frames only', least=1)
    resume: bool = option(False, 'go on: what is complete is not trained again')


@dataclass(frozen=True)
class Material:
    """The sequences, one by one: learned from, choosing the best policy, and tested on."""

    learned: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command('kfvo_ablation', _ablate, argv)


def _ablate(argv: list[str]) -> None:
    # The heavy imports come after the arguments were checked: --help answers at once.
    arguments = _parse(argv)
    options, material = from_arguments(AblationOptions, arguments), _material(arguments)
    rows = parse_names(options.rows, 'rows', ROWS)
    seeds = parse_numbers(options.seeds, 'seeds')
    import matplotlib  # noqa: F401  what is missing is told before hours of training
    import stable_baselines3  # noqa: F401
    import tensorboard  # noqa: F401

    from kfvo_ros.odometry import factory
    from kfvo_ros.training.ablation import TrainingRun
    from kfvo_ros.utils.process import single_threaded
    folder = Path(arguments.output).expanduser()
    options = replace(options, cache=options.cache or str(folder / CACHE))
    chosen = _choose(options)
    with single_threaded():
        backbone = factory.make_backbone(chosen.odometry)
        trials: list[TrainingRun] = []
        for row in rows:
            changed = replace(chosen, recipe=row_config(row, chosen.recipe, options.steps))
            plan = changed.plan(material.learned, material.validation, backbone)
            trials += [TrainingRun(row, replace(plan, seed=seed), folder) for seed in seeds]
        for trial in trials:
            trial.prepare(options.resume)
        examination = _examination(chosen, material.test, backbone)
        _go_through(trials, material, options, examination, chosen.recipe)
    print(f'\n{(folder / PAGE).read_text(encoding="utf-8")}\n'
          f'{folder / PAGE}, {folder / TABLE}, {folder / CURVES}')


def _choose(options: AblationOptions) -> TrainingSetup:
    """Return what the test and all trainings have in common; raises KfvoError."""
    from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
    from kfvo_ros.training.config import read_training_config
    from kfvo_ros.training.plan import TrainingSetup
    recipe = read_training_config(options.recipe)
    odometry = OdometryOptions(scale_rule=recipe.scale)
    return TrainingSetup(odometry.seed, recipe, odometry, SequenceOptions(stop=options.stop),
                         VggtOptions(), Path(options.cache or '').expanduser())


def _examination(chosen: TrainingSetup, test: Sequence[str], backbone: Backbone) -> PolicyEvaluation:
    """Return the test, its sequences tracked as in use; raises KfvoError."""
    from tqdm import tqdm

    from kfvo_ros.training.evaluation import PolicyEvaluation
    archive = chosen.archive(backbone)
    return PolicyEvaluation({text: archive.whole(text)
                             for text in tqdm(test, unit='sequence', desc='test')},
                            backbone, chosen.odometry)


def _go_through(trials: Sequence[TrainingRun], material: Material, options: AblationOptions,
                examination: PolicyEvaluation, recipe: TrainingConfig) -> None:
    """Train and test one after the other; table and curves tell of all that there is so far."""
    from kfvo_ros.keyframes.learned import read_policy
    outcomes = list(examination.unlearned(recipe))
    for number, trial in enumerate(trials, 1):
        print(f'{number} of {len(trials)}: {trial.row}, seed {trial.seed}', flush=True)
        if trial.is_complete():
            print(f'{trial.files.output} is complete')
        else:
            _train(trial, material, options)
        policy = read_policy(trial.files.output).policy(examination.setting)
        outcomes += examination.outcomes(trial.row, trial.seed, policy)
        _write(trials[:number], outcomes)


def _train(trial: TrainingRun, material: Material, options: AblationOptions) -> None:
    """Train as kfvo_train does, from the start or from where it was interrupted."""
    argv = [*material.learned, '--validation', *material.validation]
    for name, value in {'recipe': trial.recipe_file, 'output': trial.files.output,
                        'seed': trial.seed, 'workers': options.workers, 'cache': options.cache,
                        'stop': options.stop}.items():
        argv += [f'--{name}', str(value)] if value is not None else []
    if trial.files.checkpoint.exists():
        argv.append('--resume')
    trial.write_recipe()
    if train.main(argv) != 0:
        raise KfvoError(f'{trial.row}, seed {trial.seed}: not learned to the end, for the reason '
                        'above; --resume goes on from there')


def _write(trials: Sequence[TrainingRun], outcomes: Sequence[PolicyResult]) -> None:
    """Write what came of these trials."""
    from kfvo_ros.training.ablation import write_csv, write_markdown
    from kfvo_ros.training.curves import plot_curves, read_curve
    folder = trials[0].folder
    in_order = sorted(outcomes, key=lambda each: each.row not in ROWS)  # the learned ones first
    write_csv(folder / TABLE, in_order)
    write_markdown(folder / PAGE, in_order)
    plot_curves(folder / CURVES, [
        read_curve(trial.row, trial.plan.recipe.reward, trial.files.folder) for trial in trials])


def _material(arguments: argparse.Namespace) -> Material:
    """Return the sequences; raises KfvoError where one is tested on that chose or was learned."""
    material = Material(*map(expand_ranges, (arguments.sequence, arguments.validation,
                                             arguments.test)))
    for text in material.test:
        if text in (*material.learned, *material.validation):
            raise KfvoError(f'{text} is learned from, or chooses the best policy; expected other '
                            'sequences to --test on')
    return material


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
