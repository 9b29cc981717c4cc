# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.train``: short trainings, their files, interruption and resumption."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from command_lines import run_interrupted

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")
pytest.importorskip('tensorboard', reason="tensorboard is not installed: pip install '.[train]'")

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from kfvo_ros import run, train
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.learned import read_policy
from kfvo_ros.training.plan import TrainingFiles
from kfvo_ros.training.ppo import Trainer
from kfvo_ros.utils.files import find_config
from kfvo_ros.utils.signals import SIGNALS

pytestmark = pytest.mark.usefixtures('own_signals')

SEQUENCES = ('synthetic:1-2:smooth', '--validation', 'synthetic:3:smooth', '--stop', 25)
POLICY = 'policy.safetensors'


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    """Return a folder with a recipe of a few steps, and a cache of sequences."""
    folder = tmp_path_factory.mktemp('training')
    recipe = yaml.safe_load(find_config('train.yaml').read_text())
    recipe |= {'steps': 64, 'environments': 2, 'validation_every': 32, 'variants': 1,
               'reward': 'paper', 'teacher': None}
    recipe['augmentation'] |= {'max_stride': 1, 'drop_share': 0.0, 'frames': 25}
    recipe['ppo'] |= {'n_steps': 16, 'batch_size': 16, 'n_epochs': 2}
    (folder / 'few.yaml').write_text(yaml.safe_dump(recipe))
    return folder


def arguments(folder: Path, *more: object) -> list[str]:
    return [str(each) for each in (*SEQUENCES, '--recipe', folder / 'few.yaml', '--cache',
                                   folder / 'cache', '--output', POLICY, *more)]


@pytest.fixture(scope='module')
def trained(folder) -> Path:
    """Return the folder of a complete training."""
    with pytest.MonkeyPatch.context() as patch:
        (folder / 'first').mkdir()
        patch.chdir(folder / 'first')
        assert train.main(arguments(folder)) == 0
    return folder / 'first'


def scalars(folder: Path) -> dict[str, list[int]]:
    """Return the steps at which each scalar was logged."""
    logs = EventAccumulator(str(folder / 'policy.training')).Reload()
    return {name: [event.step for event in logs.Scalars(name)]
            for name in logs.Tags()['scalars']}


def open_logs() -> list[threading.Thread]:
    """Return the threads of TensorBoard writers."""
    return [each for each in threading.enumerate()
            if type(each).__module__.startswith('tensorboard')]


def test_smoke_needs_no_other_arguments(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train.main(['--smoke', '--stop', '30', '--steps', '200', '--output',
                       'smoke.safetensors']) == 0
    output = capsys.readouterr().out
    rows = [line.split()[0] for line in output.splitlines()]
    assert rows[1:6] == ['every', 'optical_flow', 'survival', 'teacher', 'learned,']
    assert 'best' in output.splitlines()[5]
    assert read_policy(Path('smoke.safetensors')).training['steps'] == 200
    assert not open_logs()


def test_files_logs_and_metadata_of_the_policy(trained):
    assert {path.name.split('.')[0] for path in (trained / 'policy.training').iterdir()} == {
        'checkpoint', 'last', 'events'}
    logged = scalars(trained)
    for method in ('every', 'optical_flow', 'survival', 'learned'):
        assert f'validation_ate_percent/{method}' in logged
    assert logged['validation_ate_percent/learned'] == [32, 64]
    assert {'rollout/keyframe_rate', 'rollout/ep_rew_mean', 'train/explained_variance',
            'train/value_loss', 'train/learning_rate', 'validation_kept/learned'} <= set(logged)
    metadata = read_policy(trained / 'policy.training' / 'last.safetensors').training
    assert (metadata['steps'], metadata['seed']) == (64, 0)
    assert metadata['recipe']['ppo']['n_steps'] == 16
    assert metadata['sequences'] == ['synthetic:1:smooth', 'synthetic:2:smooth']
    assert metadata['validation'] == ['synthetic:3:smooth']
    assert (metadata['reading']['stop'], metadata['reading']['rate']) == (25, 10.0)
    assert metadata['vggt'] is None
    assert metadata['command'].startswith('python -m kfvo_ros.train synthetic:1-2:smooth')
    assert all(0.0 < metadata['scores'][name]['ate_percent'] < 50.0
               and 0.1 < metadata['scores'][name]['kept'] <= 1.0
               for name in ('every', 'optical_flow', 'survival', 'learned'))


def test_the_best_policy_is_the_one_with_the_smallest_error(trained):
    best, last = (read_policy(path).training['scores']['learned']['ate_percent']
                  for path in (trained / POLICY, trained / 'policy.training/last.safetensors'))
    assert best <= last


def test_the_same_command_gives_the_same_policy(folder, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train.main(arguments(folder)) == 0
    for name in (POLICY, 'policy.training/last.safetensors'):
        assert (tmp_path / name).read_bytes() == (trained / name).read_bytes()


def test_a_policy_runs(trained, tmp_path):
    assert run.main(['synthetic:5:smooth', '--stop', '30', '--keyframes', 'learned', '--policy',
                     str(trained / POLICY), '--output', str(tmp_path)]) == 0
    summary = json.loads((tmp_path / 'summary.json').read_text())
    assert summary['keyframe_policy'] == 'learned' and summary['frames'] == 30


def test_a_training_resumes_at_its_last_step(folder, trained, tmp_path, monkeypatch, capsys):
    shutil.copytree(trained, tmp_path / 'again')
    monkeypatch.chdir(tmp_path / 'again')
    before = torch.load('policy.training/checkpoint.pt', weights_only=True)
    assert train.main(arguments(folder, '--resume', '--steps', '96')) == 0
    assert 'learned, 96 steps' in capsys.readouterr().out
    after = torch.load('policy.training/checkpoint.pt', weights_only=True)
    assert (before['steps'], after['steps']) == (64, 96)
    assert after['best'] <= before['best']
    adam_steps = [each['parameters']['policy.optimizer']['state'][0]['step']
                  for each in (before, after)]
    assert adam_steps == [8, 12]  # two epochs of two batches per rollout of 32 steps
    counts = [each['statistics']['observation']['count'] for each in (before, after)]
    assert counts[1] - counts[0] == pytest.approx(34)  # the first observations, too
    assert scalars(Path())['train/learning_rate'] == [32, 64, 96]


def test_without_a_best_policy_the_next_one_is_the_best(folder, trained, tmp_path, monkeypatch):
    shutil.copytree(trained, tmp_path / 'again')
    monkeypatch.chdir(tmp_path / 'again')
    Path(POLICY).unlink()
    assert train.main(arguments(folder, '--resume')) == 0
    assert read_policy(Path(POLICY)).training['steps'] == 64


def test_other_sequence_options_are_another_training(folder, trained, monkeypatch, capsys):
    monkeypatch.chdir(trained)
    assert train.main(arguments(folder, '--resume', '--stop', 30, '--rate', 5)) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert 'reading.rate was 10.0, now 5.0; reading.stop was 25, now 30. Go on as it ' in line


@pytest.mark.parametrize('number', SIGNALS)
def test_a_signal_to_all_processes_interrupts_and_saves(number, folder, trained, tmp_path,
                                                        monkeypatch, capsys):
    after_update = Trainer.after_update

    def interrupted(trainer: Trainer, *arguments) -> None:
        after_update(trainer, *arguments)
        for process in multiprocessing.active_children():
            os.kill(process.pid, number)
        signal.raise_signal(number)

    monkeypatch.setattr(Trainer, 'after_update', interrupted)
    monkeypatch.chdir(tmp_path)
    assert train.main(arguments(folder, '--workers', 2)) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith('kfvo_train: error: interrupted; policy.training holds the policy '
                           'after 32 steps')
    assert read_policy(Path('policy.training/last.safetensors')).training['steps'] == 32
    assert torch.load('policy.training/checkpoint.pt', weights_only=True)['steps'] == 32
    assert not open_logs()


def test_an_error_after_a_signal_is_an_interruption():
    saved = []

    def learn(display) -> None:
        signal.raise_signal(signal.SIGTERM)
        raise KfvoError('a worker process ended')

    trainer = SimpleNamespace(steps=7, learn=learn, save=lambda: saved.append(7),
                              plan=SimpleNamespace(recipe=SimpleNamespace(steps=9)))
    with pytest.raises(KfvoError, match='^interrupted; .* holds the policy after 7 steps'):
        train._learn(trainer, TrainingFiles(POLICY))
    assert saved == [7]


def test_an_interruption_saves_policy_and_checkpoint(folder, trained, tmp_path):
    output = tmp_path / POLICY
    logs = tmp_path / 'policy.training'
    status, _, problems = run_interrupted(
        signal.SIGINT, lambda: (logs / 'checkpoint.pt').exists(), '-m', 'kfvo_ros.train',
        *arguments(folder, '--steps', '100000')[:-4], '--output', output, '--steps', 100_000)
    assert status == 1
    assert problems.splitlines()[-1].startswith('kfvo_train: error: interrupted; ')
    assert str(logs) in problems.splitlines()[-1] and 'Traceback' not in problems
    steps = torch.load(logs / 'checkpoint.pt', weights_only=True)['steps']
    assert f'after {steps} steps' in problems.splitlines()[-1] and steps >= 32
    assert read_policy(logs / 'last.safetensors').training['steps'] == steps
