# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python benchmarks/training.py``: decisions per second of the environment and of PPO.

The geometric backbone is used, and sequences are tracked before the clock starts. There are more
frames than decisions: the first frames of an episode need none, and the keyframe guard takes
some.
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
from kfvo_ros.utils.files import user_path
from kfvo_ros.utils.process import single_threaded
from kfvo_ros.utils.progress import progress

COMMAND = 'benchmarks/training.py'
SEQUENCES = ('synthetic:2', 'synthetic:4', 'synthetic:6', 'synthetic:8')
WARM_UP_STEPS = 60
"""Steps after which every environment has started a new episode and all sequences are read."""


@dataclass(frozen=True)
class TrainingBenchmarkOptions:
    """What is measured, and for how long."""

    workers: str = option('1,2', 'numbers of processes to compare')
    seconds: float = option(10.0, 'length of each measurement [s]; PPO ends its rollout',
                            least=0.1, most=3600.0)
    recipe: str = option('train.yaml', 'a YAML file, or the name of one in config/')
    stop: int = option(100, 'number of frames to use of each sequence', least=1)
    cache: str | None = option(None, 'folder that keeps the tracks; default: none')


@dataclass(frozen=True)
class Throughput:
    """Decisions per second of a number of workers: the environment alone, and with PPO."""

    workers: int
    environment: float
    ppo: float


class FrameCountingBackbone(GeometricBackbone):
    """Counts the frames that it estimates."""

    frames = 0

    def estimate(self, windows: Sequence[Window]) -> list[Estimate]:
        """Estimate and count."""
        self.frames += len(windows)
        return super().estimate(windows)


@dataclass(frozen=True)
class FixedBackboneConfig(EnvironmentConfig):
    """A configuration whose environments, in this process, use a given backbone."""

    instance: Backbone | None = None

    def make_backbone(self) -> Backbone:
        """Return the given backbone."""
        assert self.instance is not None
        return self.instance


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark; return its exit status."""
    return run_command(COMMAND, _run, argv)


def _run(argv: list[str]) -> None:
    parser = make_parser(COMMAND, __doc__ or '')
    parser.add_argument('sequence', nargs='*', default=SEQUENCES, help='sequences to train on '
                        f'(default: {" ".join(SEQUENCES)})')
    add_arguments(parser, TrainingBenchmarkOptions)
    arguments = parser.parse_args(argv)
    options = from_arguments(TrainingBenchmarkOptions, arguments)
    counts, (load, *_) = parse_numbers(options.workers, 'workers', 1), os.getloadavg()
    with single_threaded(), tempfile.TemporaryDirectory() as folder:
        config, recipe = _prepare(expand_ranges(arguments.sequence), options,
                                  user_path(options.cache or folder))
        frames = count_frames_per_decision(config)
        results = [measure(config, recipe, workers, options.seconds) for workers in counts]
    print(f'{os.cpu_count()} cores (load {load:.1f} before), {recipe.environments} environments '
          f'on {len(config.sequences)} sequences, {frames:.2f} frames a decision')
    print(format_table(results, frames))


def _prepare(sequences: tuple[str, ...], options: TrainingBenchmarkOptions,
             cache: Path) -> tuple[EnvironmentConfig, TrainingConfig]:
    """Return the environments' configuration and the recipe, after tracking all sequences.

    There is one variant of each sequence.
    """
    recipe = read_training_config(options.recipe)
    recipe = replace(recipe, variants=1, augmentation=replace(recipe.augmentation, max_stride=1))
    odometry = OdometryOptions(scale_rule=recipe.scale)
    setup = TrainingSetup(odometry.seed, recipe, odometry, SequenceOptions(stop=options.stop),
                          VggtOptions(), cache)
    plan = setup.plan(sequences, (), factory.make_backbone(odometry))
    # All sequences are for training: the plan may hold some out for validation.
    config = replace(setup.environment_config(plan), sequences=sequences)
    sequence_cache = config.sequence_cache(config.make_backbone())
    for text in progress(sequences, 'sequence', 'tracking'):
        sequence_cache.variant(text, config.augmentation, 0)
    return config, recipe


def count_frames_per_decision(config: EnvironmentConfig) -> float:
    """Return the number of estimated frames per decision, over whole episodes."""
    backbone = FrameCountingBackbone(config.odometry.seed, config.tracks)
    environment = make_environment(FixedBackboneConfig(**vars(config), instance=backbone), 1, 1, 0)
    environment.reset()
    rng, steps = np.random.default_rng(0), 0
    episode_ends: list[tuple[int, int]] = []  # frames and steps so far
    while len(episode_ends) <= len(config.sequences):
        _, _, dones, _ = environment.step(rng.integers(2, size=1))
        steps += 1
        if dones[0]:
            episode_ends.append((backbone.frames, steps))
    frames, decisions = np.subtract(episode_ends[-1], episode_ends[0])
    return float(frames / decisions)


def measure(config: EnvironmentConfig, recipe: TrainingConfig, workers: int,
            seconds: float) -> Throughput:
    """Return the throughput with a number of workers; each measurement takes `seconds`."""
    with closing(make_environment(config, recipe.environments, workers, 0)) as environment:
        environment.reset()
        _step_randomly(environment, lambda steps: steps < WARM_UP_STEPS)
        alone = _rate(seconds, lambda end: recipe.environments * _step_randomly(
            environment, lambda _: time.perf_counter() < end))
        model = make_model(environment, recipe, 0)
        rollout = recipe.environments * recipe.ppo.n_steps

        def learn(end: float) -> int:
            """Learn to the end of the rollout at time `end`; return the number of decisions."""
            while time.perf_counter() < end:
                model.learn(rollout, reset_num_timesteps=False)
            return model.num_timesteps

        return Throughput(workers, alone, _rate(seconds, learn))


def _rate(seconds: float, work: Callable[[float], int]) -> float:
    """Return the rate [1/s] of `work`, called with its end time; it returns its count."""
    start = time.perf_counter()
    done = work(start + seconds)
    return done / (time.perf_counter() - start)


def _step_randomly(environment: VecEnv, proceed: Callable[[int], bool]) -> int:
    """Take random decisions while `proceed` is true of the steps so far; return the steps."""
    rng, steps = np.random.default_rng(0), 0
    while proceed(steps):
        environment.step(rng.integers(2, size=environment.num_envs))
        steps += 1
    return steps


def format_table(results: list[Throughput], frames: float) -> str:
    """Return the results as a text table; gains are relative to the first row."""
    rows = ['workers   environment: decisions/s   frames/s    gain   PPO: decisions/s    gain']
    for result in results:
        rows.append(f'{result.workers:>7}{result.environment:>27.0f}'
                    f'{frames * result.environment:>11.0f}'
                    f'{result.environment / results[0].environment:>8.2f}{result.ppo:>19.0f}'
                    f'{result.ppo / results[0].ppo:>8.2f}')
    return '\n'.join(rows)


if __name__ == '__main__':
    sys.exit(main())
