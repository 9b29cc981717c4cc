# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.train SEQUENCE... --output FILE``: learn which frames to keep, by PPO."""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError
from kfvo_ros.training.evaluation import TrainingCallback
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.process import Interrupted, signals_collected

if TYPE_CHECKING:
    from kfvo_ros.backbones.base import Backbone
    from kfvo_ros.training.evaluation import Score, Validation
    from kfvo_ros.training.plan import TrainingFiles, TrainingPlan, TrainingSetup
    from kfvo_ros.training.ppo import Training


EXAMPLES = """examples:
  python -m kfvo_ros.train --smoke --output smoke.safetensors
  python -m kfvo_ros.train synthetic:0-39 --validation synthetic:40-49 --output policy.safetensors
  python -m kfvo_ros.train TartanAir/*/*/P0* --backbone vggt --recipe train_paper.yaml \\
      --output policy.safetensors
  tensorboard --logdir policy.training
"""
NOT_OFFERED = ('keyframes', 'policy', 'flow_threshold', 'survival_share')
"""Options of an odometry that a training answers itself."""
SMOKE, SMOKE_VALIDATION = ('synthetic:1:smooth',), ('synthetic:3:smooth',)
SMOKE_FRAMES = 115
"""The local reward begins after a hundred."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command('kfvo_train', _train, argv)


def _train(argv: list[str]) -> None:
    # The heavy imports come after the arguments were checked: --help answers at once.
    arguments = _parse(argv)
    import tensorboard  # noqa: F401  who writes the logs would not tell that it is missing

    from kfvo_ros.odometry import factory
    from kfvo_ros.training.checkpoint import read_checkpoint
    from kfvo_ros.training.plan import TrainingFiles
    from kfvo_ros.training.ppo import Training
    from kfvo_ros.training.sampler import make_environment
    from kfvo_ros.utils.process import single_threaded
    files = TrainingFiles(arguments.output)
    files.check(arguments.resume, arguments.overwrite)
    chosen = _choose(arguments)
    with single_threaded():
        backbone = factory.make_backbone(chosen.odometry, chosen.vggt)
        plan = chosen.plan(arguments.sequence, arguments.validation, backbone)
        checkpoint = read_checkpoint(files.checkpoint, plan) if arguments.resume else None
        # What cannot be learned from is told before hours of validation.
        with closing(make_environment(
                chosen.lesson(plan), plan.recipe.environments, arguments.workers,
                plan.seed_at(checkpoint.steps if checkpoint else 0))) as environment:
            validation, scores = _validation(plan, chosen, backbone)
            files.prepare(arguments.resume)
            about = {'version': __version__,
                     'command': shlex.join(['python', '-m', 'kfvo_ros.train', *argv])}
            _learn(Training(plan, environment, files, validation, scores, about, checkpoint),
                   files)


def _learn(training: Training, files: TrainingFiles) -> None:
    """Learn to the end, or to an interruption; either way everything learned is in files."""
    plan = training.plan
    with signals_collected() as interruptions:
        display = Display(plan.recipe.steps, training.steps, interruptions)
        try:
            training.learn(display)
        except (Interrupted, KfvoError) as problem:
            training.save()
            # A signal to all processes may have ended what we need: that is not the problem.
            reason = 'interrupted' if interruptions else str(problem)
            raise KfvoError(
                f'{reason}; {files.folder} holds the policy after {training.steps} steps '
                f'({files.last.name}) and the checkpoint from which --resume goes on'
                ) from problem
        finally:
            display.bar.close()
    print(f'{files.output}: the {"best" if plan.validation else "last"} policy of '
          f'{training.steps} steps; checkpoint, logs and last policy are in {files.folder}')


class Display(TrainingCallback):
    """A progress bar, and a row of a table for each validation.

    Raises Interrupted once a signal is in `interruptions`.
    """

    def __init__(self, steps: int, done: int, interruptions: list[int]) -> None:
        from tqdm import tqdm
        self.bar = tqdm(total=max(steps, done), initial=done, unit='step')
        self._interruptions = interruptions

    def stepped(self, steps: int) -> None:
        """Move the bar."""
        self.bar.update(steps - self.bar.n)
        self.validating()

    def validating(self) -> None:
        """Stop here if somebody wants to."""
        if self._interruptions:
            raise Interrupted

    def collected(self, mean_return: float, keyframe_rate: float) -> None:
        """Show return and keyframe rate beside the bar."""
        shown = '-' if math.isnan(mean_return) else f'{mean_return:.3f}'
        self.bar.set_postfix_str(f'return {shown}, keyframes {100.0 * keyframe_rate:.0f} %')

    def validated(self, steps: int, score: Score, is_best: bool) -> None:
        """Print the row."""
        self.bar.write(_row(f'learned, {steps} steps', score) + ('  best' if is_best else ''))


def _row(name: str, score: Score) -> str:
    return f'{name:<26}{score.ate_percent:>10.3f} %{100.0 * score.kept:>14.1f} %'


def _validation(plan: TrainingPlan, chosen: TrainingSetup, backbone: Backbone
                ) -> tuple[Validation | None, dict[str, Score]]:
    """Return what validates, with the scores of heuristics and teacher, which are printed."""
    from tqdm import tqdm

    from kfvo_ros.odometry import factory
    from kfvo_ros.training.baselines import reference_policies
    from kfvo_ros.training.evaluation import Validation
    if not plan.validation:
        print('no validation: the last policy is the one that is kept; name sequences with '
              '--validation')
        return None, {}
    drives = chosen.archive(backbone).wholes(plan.validation)
    for _ in tqdm(drives, unit='sequence', desc='validation'):
        pass  # what cannot be read is told now, and what is tracked is kept
    validation = Validation(drives, backbone, factory.signature_of(chosen.odometry, backbone))
    print(f'{f"{len(drives)} sequences":<26}{"ATE of path":>12}{"keyframes":>16}')
    scores = {}
    for name, policy in reference_policies(plan.recipe, chosen.odometry, backbone).items():
        scores[name] = validation.score(policy)
        print(_row(name, scores[name]), flush=True)
    return validation, scores


def _choose(arguments: argparse.Namespace) -> TrainingSetup:
    """Return what the recipe says, as the command line changes it."""
    from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
    from kfvo_ros.training.config import read_training_config
    from kfvo_ros.training.plan import TrainingSetup
    from kfvo_ros.utils.config import from_arguments
    recipe = read_training_config(arguments.recipe)
    reading = from_arguments(SequenceOptions, arguments)
    if arguments.smoke:
        recipe = recipe.shortened()
        reading = replace(reading, stop=reading.stop or SMOKE_FRAMES)
    recipe = replace(recipe, steps=arguments.steps or recipe.steps,
                     reward=arguments.reward or recipe.reward,
                     environments=arguments.environments or recipe.environments)
    odometry = from_arguments(OdometryOptions, arguments)
    settled = replace(odometry, scale_rule=odometry.scale_rule or recipe.scale, seed=0)
    return TrainingSetup(odometry.seed, recipe, settled, reading,
                         from_arguments(VggtOptions, arguments),
                         Path(arguments.cache).expanduser() if arguments.cache else None)


def _parse(argv: list[str]) -> argparse.Namespace:
    from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
    from kfvo_ros.training.config import TrainOptions
    from kfvo_ros.utils.config import add_arguments
    parser = make_parser('kfvo_train', 'Learn which frames to keep: PPO of a keyframe policy.',
                         EXAMPLES)
    parser.add_argument('sequence', nargs='*', help='dataset folders or bags with ground truth, '
                        'or synthetic:A-B[:smooth|fast|mixed|street]')
    parser.add_argument('--output', required=True, help='the policy (.safetensors); checkpoint '
                        'and logs come into the .training folder beside it')
    parser.add_argument('--validation', nargs='+', default=(), metavar='SEQUENCE',
                        help='sequences by which the best policy is chosen; default: of five '
                        'sequences or more the last tenth, else none')
    add_arguments(parser, TrainOptions)
    add_arguments(parser, OdometryOptions, NOT_OFFERED)
    add_arguments(parser, VggtOptions)
    add_arguments(parser, SequenceOptions)
    arguments = parser.parse_args(argv)
    if not arguments.sequence and arguments.smoke:
        arguments.sequence = SMOKE
        arguments.validation = arguments.validation or SMOKE_VALIDATION
    if not arguments.sequence:
        parser.error('expected sequences to learn from, none came; --smoke needs none')
    if arguments.resume and arguments.overwrite:
        parser.error('expected --resume or --overwrite, both came')
    return arguments


if __name__ == '__main__':
    sys.exit(main())
