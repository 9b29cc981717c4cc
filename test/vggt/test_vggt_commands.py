# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``kfvo_run`` and ``kfvo_benchmark`` with ``--backbone vggt`` and a small random model."""

from __future__ import annotations

import csv
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from command_lines import assert_one_readable_line, run_python
from odometry_scenes import frames_of, truth_of
from policies import ALWAYS, write_policy
from sequence_writers import write_tum
from vggt_models import SMALL_CONFIG
from vggt_models import WIDTH as SMALL_WIDTH

from kfvo_ros.keyframes.base import layout_of
from kfvo_ros.keyframes.learned import PolicySignature
from kfvo_ros.trajectory import Trajectory, read_tum

COUNT, WIDTH, NATIVE_WIDTH, NATIVE_HEIGHT = 15, 140, 640, 480
FRAMES = 12
"""Frames of the benchmark."""
VGGT = ('--backbone', 'vggt', '--image-width', WIDTH)

command = partial(run_python, '-m', 'kfvo_ros.run', 'synthetic:3', '--stop', COUNT, *VGGT)


@pytest.fixture(scope='module')
def outcomes(small_vggt, tmp_path_factory) -> dict[str, tuple[Trajectory, dict]]:
    """Trajectory and summary of runs with and without reuse."""
    found = {}
    for name, more in {'reuse': (), 'recompute': ('--recompute',)}.items():
        output = tmp_path_factory.mktemp(name)
        done = command('--weights', small_vggt, '--precision', 'fp32', '--output', output, *more)
        assert done.returncode == 0, done.stderr
        assert f'{COUNT} frames' in done.stdout
        assert sorted(path.name for path in output.iterdir()) == [
            'keyframes.tum', 'summary.json', 'trajectory.tum']
        found[name] = (read_tum(output / 'trajectory.tum'),
                       json.loads((output / 'summary.json').read_text()))
    return found


def test_run_writes_trajectory_and_summary(outcomes):
    trajectory, summary = outcomes['reuse']
    assert len(trajectory) == summary['frames'] == COUNT
    assert 7 <= summary['keyframes'] <= COUNT
    assert (summary['lost_frames'], summary['extent'] > 0.0) == (0, True)
    about = {'backbone': 'vggt', 'scale_rule': 'translation', 'device': 'cpu',
             'precision': 'float32', 'ground_truth_frame': 'camera'}
    assert {name: summary[name] for name in about} == about
    assert summary['median_depth'] is None  # the model gives no points
    K = summary['estimated_intrinsics']
    assert set(K) == {'fx', 'fy', 'cx', 'cy'}
    assert K['cx'] == pytest.approx(NATIVE_WIDTH / 2)
    assert K['cy'] == pytest.approx(NATIVE_HEIGHT / 2, abs=14 * NATIVE_WIDTH / WIDTH)
    assert K['fx'] > 10.0


def test_recomputation_gives_the_same_trajectory(outcomes):
    (reused, _), (recomputed, summary) = outcomes['reuse'], outcomes['recompute']
    assert summary['keyframes'] == outcomes['reuse'][1]['keyframes']
    np.testing.assert_allclose(reused.poses, recomputed.poses, atol=1e-4)
    assert np.abs(recomputed.poses - recomputed.poses[0]).max() > 0.01


@pytest.mark.parametrize(('arguments', 'parts'), [
    (['--precision', 'fp8'], ['fp8', 'bf16']),
    (['--image-width', '7'], ['at least 14'])])
def test_invalid_options_end_in_one_line(arguments, parts, small_vggt, tmp_path):
    done = command('--weights', small_vggt, '--output', tmp_path / 'out', *arguments)
    assert_one_readable_line(done, *parts)
    assert not (tmp_path / 'out').exists()


def test_without_torch_the_error_names_the_package(tmp_path):
    script = ("import sys; sys.modules['torch'] = None; "
              'from kfvo_ros.run import main; sys.exit(main())')
    done = run_python('-c', script, 'synthetic:3', *VGGT, '--output', tmp_path / 'out')
    assert_one_readable_line(done, 'torch is missing: pip install torch')


@pytest.fixture(scope='module')
def results(small_vggt, tmp_path_factory) -> Path:
    """Output folder of kfvo_benchmark with the methods every and learned."""
    root = tmp_path_factory.mktemp('vggt')
    room = write_tum(root, [frame.image for frame in frames_of(1, FRAMES)],
                     truth_of(1, FRAMES).poses)[0]
    folder = room.rename(root / 'rgbd_dataset_freiburg1_xyz')
    policy = write_policy(root / 'policy.safetensors', PolicySignature(
        'vggt', 'none', 8, layout_of(SMALL_CONFIG.width, 8, ())), ALWAYS)
    outcome = run_python(
        '-m', 'kfvo_ros.benchmark', folder, '--backbone', 'vggt', '--scale', 'none', '--methods',
        'every,learned', '--policy', policy, '--weights', small_vggt, '--image-width', SMALL_WIDTH,
        '--precision', 'fp32', '--device', 'cpu', '--no-pictures', '--output', root / 'out')
    assert outcome.returncode == 0, outcome.stderr
    return root / 'out'


def test_benchmark_reports_the_published_rows(results):
    with (results / 'results.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))[:2]
    assert [row['method'] for row in rows] == ['every', 'learned']
    for row in rows:
        assert (row['backbone'], row['scale_rule'], row['status']) == ('vggt', 'none', 'finished')
        assert (row['frames'], row['keyframes']) == (str(FRAMES), str(FRAMES))
        assert float(row['ate_rmse_m']) > 0.0
    page = (results / 'results.md').read_text()
    assert '| Ours (published) | ✓ | No | 0.015 | 0.015 |' in page
    assert 'vggt backbone, scale rule none' in page


def test_benchmark_times_the_camera_head(results):
    path = results / 'runs' / 'rgbd_dataset_freiburg1_xyz' / 'learned' / '0' / 'summary.json'
    times = json.loads(path.read_text())['ms_per_frame']
    assert set(times) == {'encode', 'estimate', 'decide', 'total', 'head'}
    assert 0.0 < times['head']['median'] < times['estimate']['median']
    table = (results / 'results.md').read_text().partition('## Time of a frame')[2]
    head = float(table.partition('| TUM-RGBD | learned |')[2].split('|')[1])
    assert head == pytest.approx(times['head']['median'], abs=0.01)
