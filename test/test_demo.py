# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demonstration and the node benchmark: sequence, bag, node, player, evaluation."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from ros_processes import run_module

from kfvo_ros.errors import KfvoError
from kfvo_ros.ros.end_to_end import run_node
from kfvo_ros.trajectory import read_tum

pytest.importorskip('matplotlib', reason="matplotlib is not installed: pip install '.[demo]'")

SEQUENCE = 'synthetic:0:fast'


def test_demo_writes_trajectory_summary_and_plot(tmp_path: Path) -> None:
    folder = tmp_path / 'demo'
    outcome = run_module('kfvo_ros.demo', '--output', folder, '--sequence', SEQUENCE,
                         timeout=120.0)
    assert outcome.returncode == 0, outcome.stderr
    summary = json.loads((folder / 'summary.json').read_text())
    poses = read_tum(folder / 'trajectory.tum')
    assert summary['sequence'] == SEQUENCE
    assert summary['poses'] == len(poses) == summary['frames'] - summary['dropped']
    assert summary['frames'] == 200
    assert 0 < summary['keyframes'] <= summary['poses']
    # The number of dropped frames depends on the load of the machine.
    assert summary['ate_rmse_m'] < 0.05 * summary['path_length_m']
    plot = cv2.imread(str(folder / 'trajectory.png'))
    assert plot.shape[0] >= 480 and plot.std() > 5.0
    assert 'ATE after Sim(3)' in outcome.stdout


def test_demo_requires_ground_truth(tmp_path: Path) -> None:
    images = tmp_path / 'images'
    images.mkdir()
    cv2.imwrite(str(images / '0.png'), np.zeros((24, 32), dtype=np.uint8))
    outcome = run_module('kfvo_ros.demo', '--output', tmp_path / 'demo', '--sequence', images)
    assert outcome.returncode == 1
    assert 'has no ground truth to compare with' in outcome.stderr
    assert 'Traceback' not in outcome.stderr


def test_a_node_that_does_not_start_ends_the_run(tmp_path: Path) -> None:
    with pytest.raises(KfvoError, match='kfvo_node does not run'):
        run_node(tmp_path / 'bag', '/image', {'window_size': 2})


def test_node_benchmark_accounts_for_every_image() -> None:
    outcome = run_module('benchmarks.node', '--seconds', '2', timeout=120.0)
    assert outcome.returncode == 0, outcome.stderr
    lines = re.findall(r'^(20 Hz|twice capacity) .*: (\d+) images, .* (-?\d+) unaccounted',
                       outcome.stdout, re.MULTILINE)
    assert [name for name, *_ in lines] == ['20 Hz', 'twice capacity']
    assert all(int(unaccounted) == 0 for *_, unaccounted in lines)
