# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Episodes of sequences by name, in one process and in many."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.odometry.options import SequenceOptions
from kfvo_ros.training import sampler
from kfvo_ros.training.augmentation import Augmentation
from kfvo_ros.training.env import OBSERVATION, PRIVILEGED
from kfvo_ros.training.sampler import EnvironmentConfig, make_environment

FRAMES = 30
OPTIONS = SequenceOptions(stop=FRAMES)
SEQUENCES = ('synthetic:2:smooth', 'synthetic:4:smooth', 'synthetic:6:smooth')


@pytest.fixture(scope='module')
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp('cache')


def make_config(cache: Path, **changes) -> EnvironmentConfig:
    return EnvironmentConfig(SEQUENCES, OPTIONS, cache=cache,
                             augmentation=Augmentation(frames=FRAMES, max_stride=1),
                             **{'variants': 1} | changes)


def run(config: EnvironmentConfig, workers: int, seed: int = 0, steps: int = 40):
    """Return the observations and rewards of random actions in three episodes at a time."""
    environment = make_environment(config, 3, workers, seed)
    try:
        all_observations = [environment.reset()[OBSERVATION]]
        all_rewards, rng = [], np.random.default_rng(0)
        for _ in range(steps):
            observations, rewards, _, _ = environment.step(rng.integers(0, 2, 3))
            all_observations.append(observations[OBSERVATION])
            all_rewards.append(rewards)
        assert observations[PRIVILEGED].shape[0] == environment.num_envs == 3
        return np.array(all_observations), np.array(all_rewards)
    finally:
        environment.close()


def test_the_number_of_workers_changes_nothing(cache):
    observations, rewards = run(make_config(cache), workers=1)
    observations_of_two, rewards_of_two = run(make_config(cache), workers=2)
    np.testing.assert_array_equal(observations, observations_of_two)
    np.testing.assert_array_equal(rewards, rewards_of_two)


def test_the_seed_determines_the_episodes(cache):
    first, again, other = (run(make_config(cache, variants=2), 1, seed, 5)[0]
                           for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_episodes_start_anywhere_but_near_the_end(cache, monkeypatch):
    monkeypatch.setattr(sampler, 'MIN_EPISODE_FRAMES', 20)
    lengths = []
    original = sampler.Episode

    def make_episode(sequence, *others):
        lengths.append(len(sequence))
        return original(sequence, *others)

    monkeypatch.setattr(sampler, 'Episode', make_episode)
    run(make_config(cache), 1, steps=100)
    assert min(lengths) >= 20 and len(set(lengths)) > 4


def test_sequences_without_decisions_are_an_error(cache, monkeypatch):
    monkeypatch.setattr(sampler, 'MAX_EMPTY_EPISODES', 3)
    environment = make_environment(make_config(cache, guard=KeyframeGuard(0.0, 1, 0.0)), 2, 1, 0)
    with pytest.raises(KfvoError, match='synthetic:.* expected decisions to learn from, '
                                        'there were none in 3 episodes'):
        environment.reset()


def test_parts_of_the_observation_can_be_hidden(cache):
    everything = run(make_config(cache), 1, steps=1)[0]
    some = run(make_config(cache, observation=(('poses', 49), ('gap', 1))), 1, steps=1)[0]
    np.testing.assert_array_equal(some[..., :49], everything[..., 48:97])
    assert some.shape[-1] == 50


@pytest.mark.parametrize('workers', [1, 2])
@pytest.mark.parametrize('changes, expected', [
    ({'sequences': ('synthetic:4', '/nowhere')}, 'nowhere'),
    ({'sequence_options': SequenceOptions(stop=10)}, 'expected at least 20 frames'),
    ({'cache': Path('/dev/null/cache')}, 'cannot keep tracks in /dev/null/cache')])
def test_unusable_sequences_are_one_clear_line(tmp_path, workers, changes, expected):
    config = EnvironmentConfig(**{'sequences': SEQUENCES, 'sequence_options': OPTIONS,
                                  'cache': tmp_path} | changes)
    with pytest.raises(KfvoError, match=expected) as error:
        environment = make_environment(config, 2, workers, 0)
        try:
            environment.reset()
        finally:
            environment.close()
    assert '\n' not in str(error.value)
