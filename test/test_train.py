# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.train``: short trainings, their files, interruption and resumption."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from command_lines import children_of, is_running, run_interrupted, run_python, started

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
from kfvo_ros.utils import files
from kfvo_ros.utils.files import find_config
from kfvo_ros.utils.process import time_limit
from kfvo_ros.utils.signals import SIGNALS, Interrupted, signals_handled

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


@pytest.mark.parametrize('more', [(), ('--steps', 40)])
def test_resuming_a_finished_training_changes_nothing(more, folder, trained, tmp_path,
                                                      monkeypatch, capsys):
    shutil.copytree(trained, tmp_path / 'again')
    monkeypatch.chdir(tmp_path / 'again')

    def state() -> dict[str, tuple[int, bytes]]:
        return {str(path): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b'')
                for path in (Path(), *Path().rglob('*'))}

    before = state()
    capsys.readouterr()
    assert train.main(arguments(folder, '--resume', *more)) == 0
    assert state() == before
    output, errors = capsys.readouterr()
    assert errors == '' and output.startswith(f'{POLICY} is complete: all ')
    assert len(output.splitlines()) == 1


@pytest.mark.parametrize('name', [POLICY, 'policy.training/checkpoint.pt'])
def test_a_damaged_file_is_not_resumed(name, folder, trained, tmp_path, monkeypatch, capsys):
    shutil.copytree(trained, tmp_path / 'again')
    monkeypatch.chdir(tmp_path / 'again')
    content = bytearray(Path(name).read_bytes())
    content[len(content) // 2] ^= 4
    Path(name).write_bytes(content)
    capsys.readouterr()
    assert train.main(arguments(folder, '--resume', '--steps', 96)) == 1
    line, = capsys.readouterr().err.splitlines()
    assert f'{name}: ' in line and 'it is damaged, its SHA-256 is not the stored one' in line


def test_a_training_in_use_is_left_alone(folder, trained, tmp_path, monkeypatch, capsys):
    shutil.copytree(trained, tmp_path / 'again')
    monkeypatch.chdir(tmp_path / 'again')
    monkeypatch.setattr(files, 'LOCK_TIMEOUT_S', 0.1)
    with files.locked(Path('policy.training')):
        for more in (['--resume', '--steps', 96], ['--overwrite']):
            assert train.main(arguments(folder, *more)) == 1
            line = capsys.readouterr().err.splitlines()[-1]
            assert f'policy.training is in use by process {os.getpid()}: wait until' in line
    assert torch.load('policy.training/checkpoint.pt', weights_only=True)['steps'] == 64


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
    assert train.main(arguments(folder, '--workers', 2)) == 128 + number
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
    with signals_handled(), pytest.raises(Interrupted, match='holds the policy after 7 steps'):
        train._learn(trainer, TrainingFiles(POLICY))
    assert saved == [7]


def test_an_interruption_saves_policy_and_checkpoint(folder, trained, tmp_path):
    output = tmp_path / POLICY
    logs = tmp_path / 'policy.training'
    status, _, problems = run_interrupted(
        signal.SIGINT, lambda: (logs / 'checkpoint.pt').exists(), '-m', 'kfvo_ros.train',
        *arguments(folder, '--steps', '100000')[:-4], '--output', output, '--steps', 100_000)
    assert status == 128 + signal.SIGINT
    assert problems.splitlines()[-1].startswith('kfvo_train: error: interrupted; ')
    assert str(logs) in problems.splitlines()[-1] and 'Traceback' not in problems
    steps = torch.load(logs / 'checkpoint.pt', weights_only=True)['steps']
    assert f'after {steps} steps' in problems.splitlines()[-1] and steps >= 32
    assert read_policy(logs / 'last.safetensors').training['steps'] == steps


def test_a_killed_training_leaves_no_worker_and_is_resumed(folder, trained, tmp_path):
    output, logs = tmp_path / POLICY, tmp_path / 'policy.training'
    command = [*arguments(folder)[:-2], '--output', output, '--workers', 2, '--steps']
    with started('-m', 'kfvo_ros.train', *command, 100_000, stdout=subprocess.DEVNULL,
                 stderr=subprocess.DEVNULL) as process:
        end = time.monotonic() + time_limit(300.0)
        while not (logs / 'checkpoint.pt').exists():
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.02)
        workers = children_of(process.pid)
        assert len(workers) >= 2
        process.kill()
        process.wait()
        while any(map(is_running, workers)):
            assert time.monotonic() < end
            time.sleep(0.02)
    steps = torch.load(logs / 'checkpoint.pt', weights_only=True)['steps']
    done = run_python('-m', 'kfvo_ros.train', *command, steps + 32, '--resume')
    assert done.returncode == 0, done.stderr
    assert torch.load(logs / 'checkpoint.pt', weights_only=True)['steps'] == steps + 32
    assert not list(tmp_path.rglob('*.lock'))
