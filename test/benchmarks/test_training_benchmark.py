# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python benchmarks/training.py`` on short sequences."""

from __future__ import annotations

import tempfile

import pytest
import yaml

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from benchmarks import training
from benchmarks.training import Throughput, format_table
from kfvo_ros.utils.files import find_config


def test_rows_are_rates_and_tracks_are_cached(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    recipe = yaml.safe_load(find_config('train.yaml').read_text())
    recipe |= {'environments': 2}
    recipe['ppo'] |= {'n_steps': 16, 'batch_size': 16, 'n_epochs': 1}
    (tmp_path / 'few.yaml').write_text(yaml.safe_dump(recipe))
    cache = tmp_path / 'cache'
    assert training.main(['synthetic:1-2:smooth', '--stop', '30', '--workers', '1,2', '--seconds',
                          '0.2', '--recipe', str(tmp_path / 'few.yaml'),
                          '--cache', str(cache)]) == 0
    head, _, *rows = capsys.readouterr().out.splitlines()
    assert '2 environments on 2 sequences' in head
    frames = float(head.split()[-4])
    # Of about 27 frames, the first 7 and those that the guard decides need no decision.
    assert 1.25 < frames < 3.0
    values = [[float(cell) for cell in row.split()] for row in rows]
    assert [row[0] for row in values] == [1.0, 2.0]
    for _, decisions, frame_rate, _, ppo, _ in values:
        assert min(decisions, ppo) > 5.0
        assert frame_rate == pytest.approx(frames * decisions, rel=0.05)
    assert len(list(cache.iterdir())) == 2
    assert not list(tmp_path.glob('SB3-*'))  # nothing is logged


def test_gains_are_relative_to_the_first_row():
    rows = format_table([Throughput(1, 250.0, 200.0), Throughput(2, 400.0, 250.0)],
                        1.2).splitlines()
    assert rows[1].split() == ['1', '250', '300', '1.00', '200', '1.00']
    assert rows[2].split() == ['2', '400', '480', '1.60', '250', '1.25']


@pytest.mark.parametrize('workers', ['0', '1,', 'two', '-1'])
def test_workers_must_be_positive_numbers(workers, capsys):
    assert training.main([f'--workers={workers}']) == 1
    assert capsys.readouterr().err.strip() == (
        'benchmarks/training.py: error: workers: expected whole numbers from 1 to 2147483647 '
        f'with commas in between, came {workers!r}')
