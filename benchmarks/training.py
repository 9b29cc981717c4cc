# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python benchmarks/training.py``: how fast episodes are driven, and learned from.

With the geometric backbone, tracked before the clock starts. There are more frames than
decisions: the first ones of an episode, and those that the rail decides.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from kfvo_ros.backbones.base import Backbone, Estimate, Window
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.training.config import TrainingConfig, read_training_config
from kfvo_ros.training.plan import TrainingSetup
from kfvo_ros.training.ppo import make_model
from kfvo_ros.training.sampler import EnvironmentConfig, make_environment
from kfvo_ros.utils.commands import expand_ranges, make_parser, parse_numbers, run_command
from kfvo_ros.utils.config import add_arguments, from_arguments, option
from kfvo_ros.utils.process import single_threaded

SEQUENCES = ('synthetic:2', 'synthetic:4', 'synthetic:6', 'synthetic:8')
WARM_STEPS = 60
"""By then every environment has begun its drives anew, and nothing is left to be read."""


@dataclass(frozen=True)
class TrainingBenchmarkOptions:
    """What is measured, and how long."""

    workers: str = option('1,2', 'numbers of processes to compare')
    seconds: float = option(10.0, 'length of each measurement [s]; PPO ends its rollout',
                            least=0.1, most=3600.0)
    recipe: str = option('train.yaml', 'a YAML file, or the name of one in config/')
    stop: int = option(100, 'of each sequence so many frames only', least=1)
    cache: str | None = option(None, 'folder that keeps the tracks; default: none')


@dataclass(frozen=True)
class Speed:
    """Decisions per second: of the environment alone, and of PPO with it."""

    workers: int
    environment: float
    ppo: float


class CountingBackbone(GeometricBackbone):
    """Counts the frames that it places."""

    frames = 0

    def estimate(self, windows: Sequence[Window]) -> list[Estimate]:
        """Estimate and count."""
        self.frames += len(windows)
        return super().estimate(windows)


@dataclass(frozen=True)
class CountedLesson(EnvironmentConfig):
    """A lesson in this process, with a backbone that is there already."""

    counting: Backbone | None = None

    def backbone(self) -> Backbone:
        """Return that backbone."""
        assert self.counting is not None
        return self.counting


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark; return its exit status."""
    return run_command('kfvo_learning_benchmark', _run, argv)


def _run(argv: list[str]) -> None:
    parser = make_parser('kfvo_learning_benchmark', __doc__ or '')
    parser.add_argument('sequence', nargs='*', default=SEQUENCES, help='sequences to drive '
                        f'through (default: {" ".join(SEQUENCES)})')
    add_arguments(parser, TrainingBenchmarkOptions)
    arguments = parser.parse_args(argv)
    options = from_arguments(TrainingBenchmarkOptions, arguments)
    counts, (load, *_) = parse_numbers(options.workers, 'workers', 1), os.getloadavg()
    with single_threaded(), tempfile.TemporaryDirectory() as folder:
        lesson, recipe = _prepare(expand_ranges(arguments.sequence), options,
                                  Path(options.cache or folder).expanduser())
        frames = frames_per_decision(lesson)
        speeds = [measure(lesson, recipe, workers, options.seconds) for workers in counts]
    print(f'{os.cpu_count()} cores (load {load:.1f} before), {recipe.environments} environments '
          f'on {len(lesson.sequences)} sequences, {frames:.2f} frames a decision')
    print(table(speeds, frames))


def _prepare(sequences: tuple[str, ...], options: TrainingBenchmarkOptions,
             cache: Path) -> tuple[EnvironmentConfig, TrainingConfig]:
    """Return the recipe, of one variant of each sequence, and its lesson, all tracked."""
    from tqdm import tqdm
    recipe = read_training_config(options.recipe)
    recipe = replace(recipe, variants=1, augmentation=replace(recipe.augmentation, max_stride=1))
    odometry = OdometryOptions(scale_rule=recipe.scale)
    chosen = TrainingSetup(odometry.seed, recipe, odometry, SequenceOptions(stop=options.stop),
                           VggtOptions(), cache)
    backbone = factory.make_backbone(odometry)
    # Held out, as a training would, is none of them.
    lesson = replace(chosen.lesson(chosen.plan(sequences, (), backbone)), sequences=sequences)
    archive = lesson.archive(lesson.backbone())
    for text in tqdm(sequences, unit='sequence', desc='tracking'):
        archive.variant(text, lesson.augmentation, 0)
    return lesson, recipe


def frames_per_decision(lesson: EnvironmentConfig) -> float:
    """Return how many frames are placed for each decision, in whole episodes."""
    backbone = CountingBackbone(lesson.odometry.seed, lesson.tracks)
    environment = make_environment(CountedLesson(**vars(lesson), counting=backbone), 1, 1, 0)
    environment.reset()
    rng, steps = np.random.default_rng(0), 0
    begun: list[tuple[int, int]] = []  # frames and steps where an episode was over
    while len(begun) <= len(lesson.sequences):
        _, _, dones, _ = environment.step(rng.integers(2, size=1))
        steps += 1
        if dones[0]:
            begun.append((backbone.frames, steps))
    frames, decisions = np.subtract(begun[-1], begun[0])
    return float(frames / decisions)


def measure(lesson: EnvironmentConfig, recipe: TrainingConfig, workers: int, seconds: float) -> Speed:
    """Return how fast so many workers are, alone and with PPO."""
    with closing(make_environment(lesson, recipe.environments, workers, 0)) as environment:
        environment.reset()
        _drive(environment, lambda steps: steps < WARM_STEPS)
        alone = _rate(seconds, lambda end: recipe.environments * _drive(
            environment, lambda _: time.perf_counter() < end))
        model = make_model(environment, recipe, 0)
        rollout = recipe.environments * recipe.ppo.n_steps

        def learn(end: float) -> int:
            """Learn until then, to the end of a rollout; return how many decisions."""
            while time.perf_counter() < end:
                model.learn(rollout, reset_num_timesteps=False)
            return model.num_timesteps

        return Speed(workers, alone, _rate(seconds, learn))


def _rate(seconds: float, work: Callable[[float], int]) -> float:
    """Return how much a second is done by what is told when to end."""
    start = time.perf_counter()
    done = work(start + seconds)
    return done / (time.perf_counter() - start)


def _drive(environment: VecEnv, go_on: Callable[[int], bool]) -> int:
    """Decide at random while told to go on; return the steps of each environment."""
    rng, steps = np.random.default_rng(0), 0
    while go_on(steps):
        environment.step(rng.integers(2, size=environment.num_envs))
        steps += 1
    return steps


def table(speeds: list[Speed], frames: float) -> str:
    """Return the rows for people; gains are against the first."""
    rows = ['workers   environment: decisions/s   frames/s    gain   PPO: decisions/s    gain']
    for speed in speeds:
        rows.append(f'{speed.workers:>7}{speed.environment:>27.0f}'
                    f'{frames * speed.environment:>11.0f}'
                    f'{speed.environment / speeds[0].environment:>8.2f}{speed.ppo:>19.0f}'
                    f'{speed.ppo / speeds[0].ppo:>8.2f}')
    return '\n'.join(rows)


if __name__ == '__main__':
    sys.exit(main())
