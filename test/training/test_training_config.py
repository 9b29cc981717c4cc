# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recipes: the files of the config folder, and errors in others."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import layout_of
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.training.config import TrainingConfig, excluded_parts, read_training_config
from kfvo_ros.utils.config import from_mapping, to_mapping
from kfvo_ros.utils.files import find_config

LAYOUT = layout_of(48, 8, ('near', 'far'))


def read_changed(folder: Path, *keys: str, value: object = None,
                 drop: bool = False) -> TrainingConfig:
    """Read train.yaml with one value, found by its keys, changed or dropped."""
    content = yaml.safe_load(find_config('train.yaml').read_text())
    section = content
    for key in keys[:-1]:
        section = section[key]
    if drop:
        del section[keys[-1]]
    else:
        section[keys[-1]] = value
    path = folder / 'changed.yaml'
    path.write_text(yaml.safe_dump(content))
    return read_training_config(str(path))


def test_the_default_recipe():
    recipe = read_training_config('train.yaml')
    assert recipe.reward == 'local' and isinstance(recipe.guard, KeyframeGuard)
    assert recipe.scale is None and recipe.without == ('descriptor', 'poses')
    assert recipe.ppo.n_steps * recipe.environments % recipe.ppo.batch_size == 0


def test_the_paper_s_recipe():
    recipe = read_training_config('train_paper.yaml')
    assert (recipe.environments, recipe.scale, recipe.reward, recipe.alpha, recipe.guard) == (
        20, 'none', 'paper', 2.5e-5, None)
    assert (recipe.ppo.gamma, recipe.ppo.n_steps, recipe.ppo.ent_coef) == (0.6, 250, 0.0025)
    visible = set(dict(LAYOUT)) - set(excluded_parts(recipe.without, LAYOUT))
    assert visible == {'descriptor', 'poses'}


@pytest.mark.parametrize('name', ['train.yaml', 'train_paper.yaml'])
def test_every_value_has_a_source_and_the_learning_rate_is_the_paper_s(name):
    text = find_config(name).read_text()
    values = [line for line in text.splitlines() if line.strip() and line[0] != '#'
              and not line.rstrip().endswith(':')]
    lacking = [line for line in values if '#' not in line]
    # The lines of a block whose first line has the source of all.
    assert {line.split(':')[0].strip() for line in lacking} <= {'first', 'last'}
    rate = read_training_config(name).learning_rate
    assert (rate(1.0), rate(0.5), rate(0.0)) == pytest.approx((3e-4, 1.65e-4, 3e-5))
    assert rate(-0.1) == rate.last  # the last rollout may exceed the steps


def test_numbers_may_be_written_as_people_do(tmp_path: Path):
    path = tmp_path / 'own.yaml'
    text = find_config('train.yaml').read_text()
    path.write_text(text.replace('3.0e-4', '3e-4').replace('gamma: 0.98 ', 'gamma: 1 '))
    recipe = read_training_config(str(path))
    assert recipe.learning_rate.first == 3e-4 and recipe.ppo.gamma == 1.0
    assert isinstance(recipe.ppo.gamma, float)


@pytest.mark.parametrize(('keys', 'value', 'expected', 'came'), [
    (('ppo', 'gama'), 0.9, 'ppo: expected the keys n_steps, batch_size', "'gama'"),
    (('speed',), 1, 'expected the keys steps, environments', "'speed'"),
    (('steps',), 'many', 'steps: expected a whole number of at least 1', "'many'"),
    (('steps',), 1.5, 'steps: expected a whole number', '1.5'),
    (('steps',), True, 'steps: expected a whole number', 'True'),
    (('steps',), 0, 'steps: expected a whole number of at least 1', '0'),
    (('steps',), None, 'steps: expected a whole number', 'None'),
    (('ppo', 'gamma'), 1.5, 'ppo.gamma: expected a number of at least 0 and at most 1', '1.5'),
    (('ppo', 'gamma'), float('nan'), 'ppo.gamma: expected a number', 'nan'),
    (('ppo', 'gamma'), 10 ** 400, 'ppo.gamma: expected a number of at least 0', '1000'),
    (('ppo', 'normalise_reward'), 1, 'ppo.normalise_reward: expected true or false', '1'),
    (('reward',), 'praise', 'reward: expected one of local, paper', "'praise'"),
    (('rail', 'min_survival'), 2,
     'rail.min_survival: expected a number of at least 0 and at most 1', '2'),
    (('rail', 'max_gap'), 0, 'rail.max_gap: expected a whole number of at least 1', '0'),
    (('augmentation', 'max_stride'), 0, 'augmentation.max_stride: expected a whole number', '0'),
    (('without',), 'poses', 'without: expected a list of words', "'poses'"),
    (('ppo',), [1], 'ppo: expected the keys n_steps', '[1]')])
def test_a_wrong_value_is_one_clear_line(keys, value, expected, came, tmp_path: Path):
    with pytest.raises(KfvoError) as refusal:
        read_changed(tmp_path, *keys, value=value)
    line = str(refusal.value)
    assert 'changed.yaml: ' + expected in line and f'came {came}' in line and '\n' not in line


def test_missing_keys_and_files_are_named(tmp_path: Path):
    with pytest.raises(KfvoError, match='expected the key ppo.gamma, it is missing'):
        read_changed(tmp_path, 'ppo', 'gamma', drop=True)
    with pytest.raises(KfvoError, match='cannot read the recipe none_such.yaml'):
        read_training_config('none_such.yaml')
    for content in (': :', '!!python/object/apply:os.getcwd []', '\x00', '- 1', '[' * 5000):
        (tmp_path / 'bad.yaml').write_text(content)
        with pytest.raises(KfvoError, match='bad.yaml'):
            read_training_config(str(tmp_path / 'bad.yaml'))


def test_null_is_no_guard(tmp_path: Path):
    assert read_changed(tmp_path, 'rail', value=None).guard is None


def test_an_expert_needs_its_imitation(tmp_path: Path):
    with pytest.raises(KfvoError, match='imitation: expected how the teacher is imitated'):
        read_changed(tmp_path, 'imitation', value=None)


@pytest.mark.parametrize('name', ['train.yaml', 'train_paper.yaml'])
def test_a_mapping_has_the_keys_of_the_file(name):
    content = yaml.safe_load(find_config(name).read_text())
    mapping = to_mapping(read_training_config(name))
    assert json.loads(json.dumps(mapping)) == content
    assert from_mapping(TrainingConfig, mapping, name) == read_training_config(name)


def test_parts_are_excluded_by_name():
    assert excluded_parts(('poses',), LAYOUT) == ('poses',)
    assert excluded_parts(('signals',), LAYOUT) == ('near', 'far')
    assert excluded_parts(('far', 'descriptor'), LAYOUT) == ('descriptor', 'far')
    with pytest.raises(KfvoError, match='descriptor, poses, signals, near, far; came pose'):
        excluded_parts(('pose',), LAYOUT)
    with pytest.raises(KfvoError, match='expected to leave a part'):
        excluded_parts(('descriptor', 'poses', 'signals'), LAYOUT)
