# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the geometric backbone compiles: before the first frame, and as NumPy would have it."""

from __future__ import annotations

import shutil
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from kfvo_ros.backbones.geometric import keyframe_history, numba_utils


def test_no_frame_waits_for_the_compiler():
    script = textwrap.dedent('''
        import sys
        from numba.core.dispatcher import Dispatcher
        from kfvo_ros.backbones.geometric import (
            bundle_adjustment, kernels, medians, reprojection, schur)
        from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
        from kfvo_ros.keyframes.heuristics import Every
        from kfvo_ros.odometry import KeyframeOdometry
        from kfvo_ros.sequences.synthetic import SyntheticSequence

        def signatures():
            modules = (bundle_adjustment, kernels, medians, reprojection, schur)
            return {name: len(kernel.signatures) for module in modules
                    for name, kernel in vars(module).items()
                    if isinstance(kernel, Dispatcher) and not name.startswith('_')}

        backbone = GeometricBackbone()
        before = signatures()
        odometry = KeyframeOdometry(backbone, Every())
        statuses = [odometry.process(frame).status.value
                    for frame in SyntheticSequence(0, 'fast', 14, 320, 240)]
        assert statuses[-1] == 'ok', statuses
        print(before, signatures())
        sys.exit(not any(before.values()) or signatures() != before)
    ''')
    done = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                          timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def test_nearest_known_points_tell_the_median():
    rng = np.random.default_rng(2)
    places, known, values = rng.random((9, 2)), rng.random((40, 2)), rng.random(40)
    distances = np.linalg.norm(places[:, None] - known, axis=2)
    expected = np.median(values[np.argsort(distances, axis=1)[:, :5]], axis=1)
    assert np.array_equal(numba_utils.medians_of_nearest(places, known, values, 5), expected)


@pytest.mark.parametrize('sizes', [(0, 3), (7, 0), (30, 12), (12, 30)])
def test_shared_numbers_are_counted(sizes):
    rng = np.random.default_rng(4)
    a, b = (np.sort(rng.choice(40, size, replace=False)) for size in sizes)
    assert keyframe_history.count_shared(a, b) == len(np.intersect1d(a, b))


CALLER = """
from {package}.numba_utils import compiled
from {package}.callee import doubled

@compiled
def run(x):
    return doubled(x) + 1.0
"""
CALLEE = """
from {package}.numba_utils import compiled

@compiled
def doubled(x):
    return {factor} * x
"""


def test_machine_code_of_a_changed_callee_is_not_used_again(tmp_path):
    package = tmp_path / 'compiling'
    package.mkdir()
    shutil.copy(numba_utils.__file__, package)
    (package / 'caller.py').write_text(CALLER.format(package=package.name))
    answers = []
    for factor in (2.0, 3.0, 3.0):
        (package / 'callee.py').write_text(CALLEE.format(package=package.name, factor=factor))
        done = subprocess.run(
            [sys.executable, '-c', 'from compiling.caller import run; print(run(1.0), '
             'sum(run.stats.cache_hits.values()))'],
            cwd=tmp_path, capture_output=True, text=True, timeout=300)
        answers.append(done.stdout.split())
    assert answers == [['3.0', '0'], ['4.0', '0'], ['4.0', '1']], done.stderr
