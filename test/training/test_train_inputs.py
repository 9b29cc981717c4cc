# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What ``python -m kfvo_ros.train`` refuses, each in one line, and what it never does."""

from __future__ import annotations

import pickle
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from sequence_writers import make_image, write_camera_info, write_image

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")
pytest.importorskip('tensorboard', reason="tensorboard is not installed: pip install '.[train]'")

import torch

from kfvo_ros import train
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.learned import PolicySignature
from kfvo_ros.odometry.options import SequenceOptions, VggtOptions
from kfvo_ros.training.checkpoint import Checkpoint, read_checkpoint
from kfvo_ros.training.config import read_training_config
from kfvo_ros.training.plan import TrainingPlan

SETTING = PolicySignature('geometric', 'depth', 8, (('descriptor', 48), ('poses', 49)))


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch, own_signals) -> None:
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def plan() -> TrainingPlan:
    return TrainingPlan(('synthetic:1',), (), 0, SETTING, read_training_config('train.yaml'), SequenceOptions(),
                        VggtOptions())


def refused(capsys, *arguments: str) -> str:
    """Return the line with which the command refuses."""
    assert train.main(['--smoke', '--output', 'policy.safetensors', *arguments]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if 'error:' in line]
    assert len(lines) == 1 and lines[0].startswith('kfvo_train: error: ')
    return lines[0]


def test_arguments_that_are_missing_or_too_many(capsys):
    for arguments in (['--smoke', '--output', 'policy.safetensors', '--resume', '--overwrite'],
                      ['--output', 'policy.safetensors'], ['synthetic:1']):
        with pytest.raises(SystemExit) as stopped:
            train.main(arguments)
        assert stopped.value.code == 2
    assert '--output' in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--output', 'policy.pt'], ['ends in .safetensors', 'policy.pt']),
    (['--recipe', 'none.yaml'], ['cannot read the recipe none.yaml']),
    (['--resume'], ['no checkpoint', 'checkpoint.pt', 'leave --resume out']),
    (['--resume', '--recipe', 'train_paper.yaml'], ['no checkpoint']),
    (['--validation', 'synthetic:5-2'], ['synthetic:A-B', 'synthetic:5-2']),
    (['--validation', 'nowhere'], ['nowhere', 'does not exist']),
    (['--output', '/proc/none/policy.safetensors', '--stop', '25'], ['cannot write to']),
])
def test_bad_arguments_are_refused_in_one_line(arguments, words, capsys):
    line = refused(capsys, *arguments)
    assert all(word in line for word in words), line


def test_an_unknown_part_is_refused(capsys, tmp_path):
    text = Path(train.__file__).parents[1].joinpath('config', 'train.yaml').read_text()
    (tmp_path / 'own.yaml').write_text(text.replace('without: [', 'without: [pose, '))
    line = refused(capsys, '--recipe', 'own.yaml')
    assert 'without: expected names out of descriptor, poses, signals, ' in line
    assert line.endswith('came pose')


@pytest.fixture
def untrue(tmp_path) -> str:
    """Return a folder of images, whose camera was nobody knows where."""
    folder = tmp_path / 'images'
    for index in range(25):
        write_image(folder / f'{index:03d}.png', make_image(index))
    write_camera_info(folder, 20.0)
    return str(folder)


def test_a_sequence_without_truth_is_refused(untrue, capsys):
    line = refused(capsys, '--validation', untrue)
    assert 'expected ground truth of the camera to learn from, none came' in line


def test_to_learn_from_it_is_refused_before_anything_is_validated(untrue, capsys, monkeypatch):
    monkeypatch.setattr(train, '_validation', lambda *_: pytest.fail('too late'))
    line = refused(capsys, 'synthetic:1', untrue, '--validation', 'synthetic:3')
    assert 'expected ground truth of the camera to learn from, none came' in line


def test_nothing_is_overwritten_unasked(capsys, tmp_path):
    (tmp_path / 'policy.safetensors').write_text('precious')
    line = refused(capsys)
    assert 'policy.safetensors is there already' in line
    assert '--resume' in line and '--overwrite' in line
    assert (tmp_path / 'policy.safetensors').read_text() == 'precious'


class Trap:
    """Writes a file when it is unpickled."""

    def __reduce__(self):
        return open, ('sprung', 'w')


@pytest.mark.filterwarnings('ignore:Detected pickle protocol')
@pytest.mark.parametrize('how', ['pickle', 'torch', 'text', 'empty', 'tensor', 'version', 'cut',
                                 'number'])
def test_a_bad_checkpoint_is_one_clear_line_and_never_unpickled(how, plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    good = {'format_version': 1, 'plan': {}, 'steps': 1, 'best': 1.0, 'parameters': {},
            'statistics': {}}
    if how == 'pickle':
        path.write_bytes(pickle.dumps(good | {'plan': Trap()}))
    elif how == 'torch':
        torch.save(good | {'plan': Trap()}, path)
    elif how == 'tensor':
        torch.save(torch.zeros(3), path)
    elif how == 'version':
        torch.save(good | {'format_version': 2}, path)
    elif how == 'cut':
        torch.save(good, path)
        path.write_bytes(path.read_bytes()[:200])
    elif how == 'number':
        torch.save(good | {'plan': 5}, path)
    else:
        path.write_text('a checkpoint' if how == 'text' else '')
    with pytest.raises(KfvoError) as refusal:
        read_checkpoint(path, plan)
    line = str(refusal.value)
    assert str(path) in line and 'expected a checkpoint that kfvo_train wrote' in line
    assert '\n' not in line and not (tmp_path / 'sprung').exists()


@pytest.mark.parametrize('change', [
    {'seed': torch.zeros(2)}, {'sequences': (torch.zeros(2),)}, {'setting': {'observation': {1}}},
    {7: 'seven'}])
def test_a_plan_of_odd_values_is_one_clear_line(change, plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    Checkpoint(asdict(plan) | change, 5, 1.0, {}, {}).write(path)
    with pytest.raises(KfvoError, match='expected a checkpoint that kfvo_train wrote') as refusal:
        read_checkpoint(path, plan)
    assert '\n' not in str(refusal.value)


def test_a_checkpoint_goes_on_with_its_own_plan_only(plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    Checkpoint(asdict(plan), 5, 1.0, {}, {}).write(path)
    longer = replace(plan, recipe=replace(plan.recipe, steps=7, validation_every=1))
    moved = replace(plan, vggt=VggtOptions(device='cpu', recompute=True, compile=True))
    for same in (plan, longer, moved):
        assert read_checkpoint(path, same).steps == 5
    ppo = replace(plan.recipe.ppo, gamma=0.5)
    smaller = replace(SETTING, observation=SETTING.observation[:1])
    for other, words in (
            (replace(plan, recipe=replace(plan.recipe, ppo=ppo)),
             f'recipe.ppo.gamma was {plan.recipe.ppo.gamma}'),
            (replace(plan, setting=smaller), 'setting.observation was'),
            (replace(plan, seed=3), 'seed was 0, now 3'),
            (replace(plan, recipe=replace(plan.recipe, rail=None)), 'recipe.rail was'),
            (replace(plan, reading=SequenceOptions(stop=9)), 'reading.stop was None, now 9'),
            (replace(plan, reading=SequenceOptions(camera='my.yaml', rate=20.0)),
             "reading.camera was None, now 'my.yaml'; reading.rate was 10.0, now 20.0"),
            (replace(plan, vggt=VggtOptions('my.pt')), "vggt.weights was 'facebook/VGGT-1B'"),
            (replace(plan, sequences=('synthetic:2',)), 'sequences was')):
        with pytest.raises(KfvoError, match='is of another training') as refusal:
            read_checkpoint(path, other)
        assert words in str(refusal.value) and '\n' not in str(refusal.value)


def test_a_checkpoint_of_an_older_version_does_not_tell_everything(plan, tmp_path):
    path = tmp_path / 'checkpoint.pt'
    told = {name: value for name, value in asdict(plan).items() if name not in ('reading', 'vggt')}
    Checkpoint(told, 5, 1.0, {}, {}).write(path)
    assert read_checkpoint(path, plan).steps == 5
