# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.ablation``: rows of short trainings, their table, and resumption."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")
pytest.importorskip('tensorboard', reason="tensorboard is not installed: pip install '.[train]'")
pytest.importorskip('matplotlib', reason="matplotlib is not installed: pip install '.[demo]'")

from kfvo_ros import ablation
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.learned import read_policy
from kfvo_ros.odometry import factory
from kfvo_ros.training.ablation import PolicyTest, make_setup, read_ablation_rows
from kfvo_ros.training.ablation_report import read_curve
from kfvo_ros.training.config import read_training_config
from kfvo_ros.training.rewards import ALPHA
from kfvo_ros.utils.files import find_config

TRAINED = ('full', 'local_signals_only')
TESTED = ('synthetic:5:smooth', 'synthetic:6:smooth')
REFERENCES = ('every', 'optical_flow', 'survival', 'random', 'rail', 'constant_position',
             'straight_line')


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    """Return a folder with a recipe of short rollouts."""
    folder = tmp_path_factory.mktemp('ablation')
    recipe = yaml.safe_load(find_config('train.yaml').read_text())
    recipe |= {'environments': 2, 'variants': 1, 'validation_every': 64, 'teacher': None}
    recipe['augmentation'] |= {'max_stride': 1, 'drop_share': 0.0}
    recipe['ppo'] |= {'n_steps': 16, 'batch_size': 16, 'n_epochs': 1}
    (folder / 'few.yaml').write_text(yaml.safe_dump(recipe))
    return folder


def run(folder: Path, output: Path, *more: object) -> int:
    """Run it on 30 frames of each sequence; `more` arguments win over these."""
    return ablation.main([str(each) for each in (
        'synthetic:1-2:smooth', '--validation', 'synthetic:3:smooth', '--test',
        'synthetic:5-6:smooth', '--stop', 30, '--recipe', folder / 'few.yaml', '--cache',
        folder / 'cache', '--rows', ','.join(TRAINED), '--seeds', '0,1', '--steps', 64,
        '--output', output, *more)])


@pytest.fixture(scope='module')
def done(folder) -> Path:
    """Return the output of an ablation of two rows and two seeds."""
    assert run(folder, folder / 'done') == 0
    return folder / 'done'


def refused(capsys, *arguments: object) -> str:
    """Return the one line with which the ablation itself refuses."""
    assert ablation.main([str(each) for each in arguments]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines()
             if line.startswith('kfvo_ablation: error: ')]
    assert len(lines) == 1
    return lines[0]


def files(output: Path) -> dict[str, int]:
    """Return the modification time of each policy."""
    return {path.name: path.stat().st_mtime_ns for path in output.glob('*.safetensors')}


def test_every_row_seed_and_sequence_is_there(done):
    with (done / 'ablation.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(dict.fromkeys(row['row'] for row in rows)) == TRAINED + REFERENCES
    seeds = {row: ['0', '1'] for row in TRAINED} | {'random': ['0', '1', '2']}
    for name in TRAINED + REFERENCES:
        assert [(row['seed'], row['sequence']) for row in rows if row['row'] == name] == [
            (seed, text) for seed in seeds.get(name, ['']) for text in TESTED]
    value = {(row['row'], row['sequence']): float(row['ate_percent']) for row in rows}
    assert all(value['constant_position', text] > value['straight_line', text]
               > value['every', text] > 0.0 for text in TESTED)
    kept = {row['row']: float(row['kept']) for row in rows}
    assert kept['every'] == 1.0 > kept['random'] > kept['rail'] > kept['straight_line'] == 0.0


def test_the_table_has_all_rows_and_the_curves_are_plotted(done):
    lines = (done / 'ablation.md').read_text().splitlines()
    assert [line.split('`')[1] for line in lines if line.startswith('| `')] \
        == list(TRAINED + REFERENCES)
    assert sum('geometric mean over 2 sequences' in line for line in lines) == 1
    picture = cv2.imread(str(done / 'curves.png'))
    assert picture.shape[1] > 2 * picture.shape[0] and len(np.unique(picture)) > 50


def test_the_expert_has_a_row_of_its_own(folder):
    recipe = read_training_config('train.yaml')
    setup = make_setup('train.yaml', 30, folder / 'cache')
    test = PolicyTest.load(TESTED[:1], setup, factory.make_backbone(setup.odometry))
    results = list(test.reference_results(recipe))
    assert [each.row for each in results if each.row != 'random'] == [
        *REFERENCES[:3], 'teacher', *REFERENCES[4:]]
    expert = next(each for each in results if each.row == 'teacher')
    assert 0.0 < expert.kept <= 1.0 and expert.ate_percent > 0.0


def test_each_row_is_trained_by_its_recipe(done):
    policies = {row: read_policy(done / f'{row}-1.safetensors') for row in TRAINED}
    parts = {row: {name for name, _ in policy.signature.observation}
             for row, policy in policies.items()}
    assert parts['full'] == {'descriptor', 'poses'}
    assert parts['local_signals_only'] and not parts['local_signals_only'] & parts['full']
    assert [policy.training['recipe']['reward'] for policy in policies.values()] == [
        'paper', 'local']
    assert [policy.training['seed'] for policy in policies.values()] == [1, 1]
    assert read_training_config(str(done / 'full.yaml')) == read_ablation_rows(
        read_training_config(str(done.parent / 'few.yaml')), 64)['full']
    command = policies['full'].training['command']
    assert command.startswith('python -m kfvo_ros.train synthetic:1:smooth synthetic:2:smooth')
    assert str(done / 'full.yaml') in command


def test_curves_hold_the_logged_values(done):
    curve = read_curve('full', 'paper', done / 'full-0.training')
    assert curve.errors[:, 0].tolist() == [32.0, 64.0]
    assert curve.returns[-1, 0] == 64.0  # by then an episode has ended
    assert np.isfinite(curve.returns).all() and (curve.errors > 0.0).all()
    best = read_policy(done / 'full-0.safetensors').training['scores']
    assert curve.errors[:, 1].min() == pytest.approx(best['learned']['ate_percent'])
    assert curve.references == {name: pytest.approx(best[name]['ate_percent'])
                                for name in ('every', 'optical_flow', 'survival')}


def test_a_complete_training_is_not_repeated(folder, done, tmp_path, capsys):
    output = tmp_path / 'again'
    shutil.copytree(done, output)
    (output / 'full-1.safetensors').unlink()
    shutil.rmtree(output / 'full-1.training')
    before, recipe = files(output), (output / 'local_signals_only.yaml').stat()
    first = output / 'full-0.training' / 'last.safetensors'
    policy = read_policy(first)
    replace(policy, training={key: value for key, value in policy.training.items()
                              if key != 'reading'}).write(first)  # as an older version did
    assert run(folder, output, '--resume') == 0
    assert (output / 'local_signals_only.yaml').stat() == recipe
    assert capsys.readouterr().out.count(' is complete\n') == 3
    after = files(output)
    assert {name for name in after if after[name] != before.get(name)} == {'full-1.safetensors'}
    for name in ('ablation.csv', 'ablation.md'):
        assert (output / name).read_bytes() == (done / name).read_bytes()


def test_an_incomplete_training_is_resumed(folder, tmp_path, capsys):
    one = ('--rows', 'without_pose', '--seeds', 0)
    assert run(folder, tmp_path, *one, '--steps', 32) == 0
    assert run(folder, tmp_path, *one, '--resume') == 0
    assert 'learned, 64 steps' in capsys.readouterr().out
    curve = read_curve('without_pose', 'paper', tmp_path / 'without_pose-0.training')
    assert curve.errors[:, 0].tolist() == [32.0, 64.0]


@pytest.mark.parametrize(('lost', 'others', 'words'), [
    ('', ['--recipe', 'other.yaml'], 'recipe.ppo.gamma was 0.98, now 0.5. Go on as it began'),
    ('', ['--stop', 25], 'full-0.training/checkpoint.pt is of another training: reading.stop was '
     '30, now 25'),
    ('full-0.training/checkpoint.pt', ['--recipe', 'other.yaml'],
     'full-0.safetensors is of another training, or has lost its checkpoint')])
def test_another_training_is_not_resumed(folder, done, tmp_path, capsys, monkeypatch, lost, others,
                                         words):
    output = tmp_path / 'other'
    shutil.copytree(done, output)
    if lost:
        (output / lost).unlink()
    monkeypatch.chdir(tmp_path)
    recipe = (folder / 'few.yaml').read_text().replace('gamma: ', 'gamma: 0.5  # ')
    (tmp_path / 'other.yaml').write_text(recipe)
    assert run(folder, output, '--resume', *others) == 1
    line, = [line for line in capsys.readouterr().err.splitlines() if 'error:' in line]
    assert line.startswith('kfvo_ablation: error: ') and words in line
    for row in TRAINED:  # which the policies name
        assert (output / f'{row}.yaml').read_bytes() == (done / f'{row}.yaml').read_bytes()


def test_nothing_is_overwritten_by_default(folder, done, tmp_path, capsys):
    before = files(done)
    assert run(folder, done) == 1
    assert 'full-0.safetensors is there already' in capsys.readouterr().err
    assert files(done) == before
    (tmp_path / 'local_signals_only-1.safetensors').write_text('precious')
    assert run(folder, tmp_path) == 1  # before any other is trained
    assert 'local_signals_only-1.safetensors is there already' in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['local_signals_only-1.safetensors']


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--rows', 'full,without_poses'], ['without_pose, ', "came 'without_poses'"]),
    (['--seeds', '0,one'], ['whole numbers', "came '0,one'"]),
    (['--recipe', 'none.yaml'], ['cannot read the recipe none.yaml']),
    (['--test', 'nowhere'], ['nowhere', 'does not exist']),
    (['--test', 'synthetic:9-1'], ['synthetic:A-B', 'synthetic:9-1']),
    (['--test', 'synthetic:2'], ['synthetic:2 is learned from', '--test']),
    (['--test', 'synthetic:3'], ['synthetic:3 is learned from', '--test'])])
def test_bad_arguments_are_refused_in_one_line(arguments, words, capsys, tmp_path):
    line = refused(capsys, 'synthetic:1-2', '--validation', 'synthetic:3', '--test',
                   'synthetic:4', '--output', tmp_path, *arguments)
    assert all(word in line for word in words), line


@pytest.mark.parametrize('missing', ['--test', '--validation', '--output'])
def test_a_missing_argument_is_named(missing, capsys):
    given = {'--test': 'synthetic:4', '--validation': 'synthetic:3', '--output': 'here'}
    with pytest.raises(SystemExit) as stopped:
        ablation.main(['synthetic:1', *(text for name, value in given.items() if name != missing
                                        for text in (name, value))])
    assert stopped.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].endswith(f'required: {missing}')


def test_rows_differ_from_full_in_one_key():
    recipe = read_training_config('train.yaml')
    rows = read_ablation_rows(recipe, 80_000)
    assert list(rows) == ['full', 'without_pose', 'without_descriptor', 'without_alpha',
                          'alpha_penalty', 'local', 'local_signals_only', 'local_untaught']
    full = vars(rows['full'])
    assert (full['reward'], full['alpha'], full['without'], full['expert']) == (
        'paper', ALPHA, ('signals',), None)
    assert (full['steps'], full['validation_every']) == (80_000, 10_000)

    def changed(row: str, other: str) -> dict[str, object]:
        return {key: value for key, value in vars(rows[row]).items()
                if value != vars(rows[other])[key]}

    assert changed('without_pose', 'full') == {'without': ('poses', 'signals')}
    assert changed('without_descriptor', 'full') == {'without': ('descriptor', 'signals')}
    assert changed('without_alpha', 'full') == {'alpha': 0.0}
    assert changed('alpha_penalty', 'full') == {'alpha': -2.5e-5}
    assert {key for key, value in vars(rows['local']).items() if value != vars(recipe)[key]} \
        == {'steps', 'validation_every', 'without'}
    assert changed('local_signals_only', 'local') == {'without': ('descriptor', 'poses')}
    assert changed('local_untaught', 'local_signals_only') == {'expert': None}


@pytest.mark.parametrize(('rows', 'words'), [
    ('near: {rewards: paper}', 'near: expected the keys steps, environments'),
    ('near: {ppo: {gama: 0.5}}', "near.ppo: expected the keys n_steps, batch_size"),
    ('near: {reward: praise}', 'near.reward: expected one of local, paper; came'),
    ('near: {imitation: null}', 'near.imitation: expected how the teacher is imitated'),
    ('near: paper', 'near: expected the keys steps, environments'),
    ('[near, far]', 'expected rows with the keys that they change; came'),
    ('near: [', 'cannot read the rows ablation.yaml')])
def test_a_wrong_row_is_one_clear_line(rows, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'ablation.yaml').write_text(rows)
    with pytest.raises(KfvoError) as refusal:
        read_ablation_rows(read_training_config('train.yaml'), 64)
    line = str(refusal.value)
    assert 'ablation.yaml: ' in line and words in line and '\n' not in line


def test_rows_may_change_nested_keys(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'ablation.yaml').write_text('far: {ppo: {gamma: 0.5}, steps: 9}\nsame: {}\n')
    recipe = read_training_config('train.yaml')
    rows = read_ablation_rows(recipe, 64)
    assert rows['same'] == replace(recipe, steps=64, validation_every=8)
    assert rows['far'] == replace(rows['same'], steps=9, ppo=replace(recipe.ppo, gamma=0.5))
