# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's rows by ``benchmark --backbone vggt --scale none``, with small random weights."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from command_lines import run_python
from odometry_scenes import frames_of, truth_of
from policies import ALWAYS, write_policy
from sequence_writers import write_tum
from vggt_models import SMALL, WIDTH, frames_seen, small_model, window_of

from kfvo_ros.backbones.vggt.backbone import VggtBackbone
from kfvo_ros.keyframes.base import layout_of
from kfvo_ros.keyframes.learned import PolicySignature

COUNT = 12


@pytest.fixture(scope='module')
def done(small_vggt, tmp_path_factory) -> Path:
    """Return the folder of a benchmark of the paper's row, and of VGGT-SW."""
    root = tmp_path_factory.mktemp('vggt')
    room = write_tum(root, [frame.image for frame in frames_of(1, COUNT)],
                     truth_of(1, COUNT).poses)[0]
    folder = room.rename(root / 'rgbd_dataset_freiburg1_xyz')
    policy = write_policy(root / 'policy.safetensors', PolicySignature(
        'vggt', 'none', 8, layout_of(SMALL.width, 8, ())), ALWAYS)
    outcome = run_python(
        '-m', 'kfvo_ros.benchmark', folder, '--backbone', 'vggt', '--scale', 'none', '--methods',
        'every,learned', '--policy', policy, '--weights', small_vggt, '--image-width', WIDTH,
        '--precision', 'fp32', '--device', 'cpu', '--no-pictures', '--output', root / 'out')
    assert outcome.returncode == 0, outcome.stderr
    return root / 'out'


def test_the_papers_rows(done):
    with (done / 'results.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))[:2]
    assert [row['method'] for row in rows] == ['every', 'learned']
    for row in rows:
        assert (row['backbone'], row['scale_rule'], row['status']) == ('vggt', 'none', 'finished')
        assert (row['frames'], row['keyframes']) == (str(COUNT), str(COUNT))
        assert float(row['ate_rmse_m']) > 0.0
    page = (done / 'results.md').read_text()
    assert '| Ours (published) | ✓ | No | 0.015 | 0.015 |' in page
    assert 'vggt backbone, scale rule none' in page


def test_the_head_is_a_part_of_estimating(done):
    path = done / 'runs' / 'rgbd_dataset_freiburg1_xyz' / 'learned' / '0' / 'summary.json'
    times = json.loads(path.read_text())['ms_per_frame']
    assert set(times) == {'encode', 'estimate', 'decide', 'total', 'head'}
    assert 0.0 < times['head']['median'] < times['estimate']['median']
    table = (done / 'results.md').read_text().partition('## Time of a frame')[2]
    head = float(table.partition('| TUM-RGBD | learned |')[2].split('|')[1])
    assert head == pytest.approx(times['head']['median'], abs=0.01)


def test_a_batch_tells_the_share_of_each_window():
    backbone = VggtBackbone(small_model(), WIDTH)
    windows = [window_of(backbone, frames_seen(3, seed)) for seed in (0, 1)]
    estimates = backbone.estimate(windows)
    shares = [estimate.durations['head'] for estimate in estimates]
    assert shares[0] == shares[1] > 0.0
