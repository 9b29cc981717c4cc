# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.train SEQUENCE... --output FILE``: train a keyframe policy by PPO."""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.files import locked, user_path
from kfvo_ros.utils.progress import progress, progress_bar
from kfvo_ros.utils.signals import Interrupted, interrupted, raise_if_interrupted

if TYPE_CHECKING:
    from kfvo_ros.backbones.base import Backbone
    from kfvo_ros.training.evaluation import PolicyEvaluation, Score
    from kfvo_ros.training.plan import TrainingFiles, TrainingPlan, TrainingSetup
    from kfvo_ros.training.ppo import Trainer

EXAMPLES = """examples:
  python -m kfvo_ros.train --smoke --output smoke.safetensors
  python -m kfvo_ros.train synthetic:0-39 --validation synthetic:40-49 --output policy.safetensors
  python -m kfvo_ros.train TartanAir/*/*/P0* --backbone vggt --recipe train_paper.yaml \\
      --output policy.safetensors
  tensorboard --logdir policy.training
"""
WITHOUT_OPTIONS = ('keyframes', 'policy', 'flow_threshold', 'survival_share')
"""Options of the odometry that choose a keyframe policy."""
SMOKE_SEQUENCES, SMOKE_VALIDATION = ('synthetic:1:smooth',), ('synthetic:3:smooth',)
SMOKE_FRAMES = 115
"""The local reward begins after 100 frames."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command('kfvo_train', _train, argv)


def _train(argv: list[str]) -> None:
    # The heavy imports come after the arguments were checked: --help answers at once.
    arguments = _parse(argv)
    import tensorboard  # noqa: F401  torch's writer would not name the missing package

    from kfvo_ros.odometry import factory
    from kfvo_ros.training.checkpoint import is_finished, read_checkpoint
    from kfvo_ros.training.plan import TrainingFiles
    from kfvo_ros.training.ppo import Trainer
    from kfvo_ros.training.sampler import make_environment
    from kfvo_ros.utils.process import single_threaded
    files = TrainingFiles(arguments.output)
    files.check(arguments.resume, arguments.overwrite)
    setup = _make_setup(arguments)
    metadata = {'version': __version__,
                'command': shlex.join(['python', '-m', 'kfvo_ros.train', *argv])}
    with single_threaded():
        backbone = factory.make_backbone(setup.odometry, setup.vggt)
        plan = setup.plan(arguments.sequence, arguments.validation, backbone)
        if arguments.resume and is_finished(files, plan):
            print(f'{files.output} is complete: all {plan.recipe.steps} steps are done, nothing '
                  'changes; go on with more --steps, or train it again with --overwrite')
            return
        with locked(files.folder):
            checkpoint = read_checkpoint(files.checkpoint, plan) if arguments.resume else None
            # The environment first: it refuses sequences before a long validation.
            with closing(make_environment(
                    setup.environment_config(plan), plan.recipe.environments, arguments.workers,
                    plan.seed_at(checkpoint.steps if checkpoint else 0))) as environment:
                validation = _make_validation(plan, setup, backbone)
                scores = _score_references(validation, plan, setup) if validation else {}
                files.prepare(arguments.resume)
                _learn(Trainer(plan, environment, files, validation, scores, metadata,
                               checkpoint), files)


def _make_setup(arguments: argparse.Namespace) -> TrainingSetup:
    """Return the recipe and options, as the command line changes the recipe."""
    from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
    from kfvo_ros.training.config import read_training_config
    from kfvo_ros.training.plan import TrainingSetup
    from kfvo_ros.utils.config import from_arguments
    recipe = read_training_config(arguments.recipe)
    sequence_options = from_arguments(SequenceOptions, arguments)
    if arguments.smoke:
        recipe = recipe.shortened()
        sequence_options = replace(sequence_options, stop=sequence_options.stop or SMOKE_FRAMES)
    recipe = replace(recipe, steps=arguments.steps or recipe.steps,
                     reward=arguments.reward or recipe.reward,
                     environments=arguments.environments or recipe.environments)
    odometry = from_arguments(OdometryOptions, arguments)
    return TrainingSetup(
        odometry.seed, recipe,
        replace(odometry, scale_rule=odometry.scale_rule or recipe.scale, seed=0),
        sequence_options, from_arguments(VggtOptions, arguments),
        user_path(arguments.cache) if arguments.cache else None)


def _make_validation(plan: TrainingPlan, setup: TrainingSetup,
                     backbone: Backbone) -> PolicyEvaluation | None:
    """Return the evaluation that chooses the best policy, None without sequences."""
    from kfvo_ros.odometry import factory
    from kfvo_ros.training.evaluation import PolicyEvaluation
    if not plan.validation:
        print('no validation: the last policy is the one that is kept; name sequences with '
              '--validation')
        return None
    sequences = setup.sequence_cache(backbone).sequences(plan.validation)
    for _ in progress(sequences, 'sequence', 'validation'):
        pass  # encode and cache all of them now, and refuse what cannot be read
    return PolicyEvaluation(sequences, backbone, factory.signature_of(setup.odometry, backbone))


def _score_references(validation: PolicyEvaluation, plan: TrainingPlan,
                      setup: TrainingSetup) -> dict[str, Score]:
    """Return the validation scores of heuristics and expert by name, and print them."""
    from kfvo_ros.training.evaluation import reference_policies
    print(f'{f"{len(validation.sequences)} sequences":<26}{"ATE of path":>12}{"keyframes":>16}')
    scores = {}
    for name, policy in reference_policies(plan.recipe, setup.odometry,
                                           validation.backbone).items():
        scores[name] = validation.score(policy)
        print(_format_score(name, scores[name]), flush=True)
    return scores


def _learn(trainer: Trainer, files: TrainingFiles) -> None:
    """Train to the end; after an interruption or an error save first, then raise it."""
    with closing(ProgressDisplay(trainer.plan.recipe.steps, trainer.steps)) as display:
        try:
            trainer.learn(display)
        except (Interrupted, KfvoError) as problem:
            trainer.save()
            kept = (f'{files.folder} holds the policy after {trainer.steps} steps '
                    f'({files.last.name}) and the checkpoint from which --resume goes on')
            # A signal to the process group may have ended workers, which is a KfvoError.
            raise (Interrupted(kept) if interrupted() else KfvoError(f'{problem}; {kept}')
                   ) from problem
    print(f'{files.output}: the {"best" if trainer.plan.validation else "last"} policy of '
          f'{trainer.steps} steps; checkpoint, logs and last policy are in {files.folder}')


class ProgressDisplay:
    """A `TrainingCallback` with a progress bar and a table row for each validation.

    Raises Interrupted after a signal.
    """

    def __init__(self, steps: int, done: int) -> None:
        self._bar = progress_bar(max(steps, done), 'step', initial=done)

    def on_step(self, steps: int) -> None:
        """Move the bar."""
        self._bar.update(steps - self._bar.n)
        raise_if_interrupted()

    def on_rollout(self, mean_return: float, keyframe_rate: float) -> None:
        """Show return and keyframe rate beside the bar."""
        shown = '-' if math.isnan(mean_return) else f'{mean_return:.3f}'
        self._bar.set_postfix_str(f'return {shown}, keyframes {100.0 * keyframe_rate:.0f} %')

    def on_validation_sequence(self) -> None:
        """Stop here after a signal."""
        raise_if_interrupted()

    def on_validation(self, steps: int, score: Score, is_best: bool) -> None:
        """Print the row."""
        self._bar.write(_format_score(f'learned, {steps} steps', score)
                        + ('  best' if is_best else ''))

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()


def _format_score(name: str, score: Score) -> str:
    return f'{name:<26}{score.ate_percent:>10.3f} %{100.0 * score.kept:>14.1f} %'


def _parse(argv: list[str]) -> argparse.Namespace:
    from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
    from kfvo_ros.training.config import TrainOptions
    from kfvo_ros.utils.config import add_arguments
    parser = make_parser('kfvo_train', 'Train a keyframe policy by PPO.', EXAMPLES)
    parser.add_argument('sequence', nargs='*', help='dataset folders or bags with ground truth, '
                        'or synthetic:A-B[:smooth|fast|mixed|street]')
    parser.add_argument('--output', required=True, help='the policy (.safetensors); checkpoint '
                        'and logs are in the .training folder beside it')
    parser.add_argument('--validation', nargs='+', default=(), metavar='SEQUENCE',
                        help='sequences that choose the best policy; default: the last tenth of '
                        'five sequences or more, else none')
    add_arguments(parser, TrainOptions)
    add_arguments(parser, OdometryOptions, WITHOUT_OPTIONS)
    add_arguments(parser, VggtOptions)
    add_arguments(parser, SequenceOptions)
    arguments = parser.parse_args(argv)
    if not arguments.sequence and arguments.smoke:
        arguments.sequence = SMOKE_SEQUENCES
        arguments.validation = arguments.validation or SMOKE_VALIDATION
    if not arguments.sequence:
        parser.error('expected sequences to learn from, none came; --smoke needs none')
    if arguments.resume and arguments.overwrite:
        parser.error('expected --resume or --overwrite, both came')
    return arguments


if __name__ == '__main__':
    sys.exit(main())
