# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.train``: errors of its arguments and inputs, each in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from sequence_writers import make_image, write_camera_info, write_image

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")
pytest.importorskip('tensorboard', reason="tensorboard is not installed: pip install '.[train]'")

from kfvo_ros import train


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch) -> None:
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)


def refused(capsys, *arguments: str) -> str:
    """Return the line with which the command refuses."""
    assert train.main(['--smoke', '--output', 'policy.safetensors', *arguments]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if 'error:' in line]
    assert len(lines) == 1 and lines[0].startswith('kfvo_train: error: ')
    return lines[0]


def test_missing_and_conflicting_arguments(capsys):
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
def without_truth(tmp_path) -> str:
    """Return a folder of images without ground truth."""
    folder = tmp_path / 'images'
    for index in range(25):
        write_image(folder / f'{index:03d}.png', make_image(index))
    write_camera_info(folder, 20.0)
    return str(folder)


def test_a_sequence_without_truth_is_refused(without_truth, capsys):
    line = refused(capsys, '--validation', without_truth)
    assert 'expected ground truth of the camera to learn from, none came' in line


def test_such_a_training_sequence_is_refused_before_validation(without_truth, capsys,
                                                               monkeypatch):
    monkeypatch.setattr(train, '_make_validation', lambda *_: pytest.fail('too late'))
    line = refused(capsys, 'synthetic:1', without_truth, '--validation', 'synthetic:3')
    assert 'expected ground truth of the camera to learn from, none came' in line


def test_nothing_is_overwritten_by_default(capsys, tmp_path):
    (tmp_path / 'policy.safetensors').write_text('precious')
    line = refused(capsys)
    assert 'policy.safetensors is there already' in line
    assert '--resume' in line and '--overwrite' in line
    assert (tmp_path / 'policy.safetensors').read_text() == 'precious'
