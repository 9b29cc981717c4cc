# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test when kernels are compiled, and the cache of machine code."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

from kfvo_ros.backbones.geometric import numba_utils

SIGNATURES_DURING_A_SEQUENCE = """
    import importlib, itertools, json, pkgutil
    from numba.core.dispatcher import Dispatcher
    from kfvo_ros.backbones import geometric
    from kfvo_ros.backbones.geometric import numba_utils
    from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
    from kfvo_ros.keyframes.heuristics import EveryFrame
    from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
    from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence

    modules = [importlib.import_module(f'{geometric.__name__}.{module.name}')
               for module in pkgutil.iter_modules(geometric.__path__)]

    def signatures():
        return {kernel.py_func.__qualname__: [str(types) for types in kernel.signatures]
                for module in modules for kernel in vars(module).values()
                if isinstance(kernel, Dispatcher)}

    class RecordingBackbone(GeometricBackbone):
        def estimate(self, windows):
            self.estimates = super().estimate(windows)
            return self.estimates

    imported = signatures()
    backbone = RecordingBackbone()
    constructed = signatures()
    odometry = KeyframeOdometry(backbone, EveryFrame())
    for frame in itertools.islice(SyntheticSequence(0, 'fast', 40, 320, 240), 24):
        odometry.process(frame)
    last, = backbone.estimates
    assert last.status.value == 'ok', last.status
    assert last.covariance.any()
    assert last.memory.intrinsics_filter.last_frame > 0, 'the intrinsics were estimated'
    entry_points = [kernel.py_func.__qualname__ for kernel, _ in numba_utils._entry_points]
    print(json.dumps([imported, constructed, signatures(), entry_points]))
"""


def run_script(script: str, folder: Path | None = None) -> str:
    done = subprocess.run([sys.executable, '-c', textwrap.dedent(script)], cwd=folder,
                          capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_kernels_are_compiled_for_all_calls_when_a_backbone_is_constructed():
    imported, constructed, final, entry_points = json.loads(
        run_script(SIGNATURES_DURING_A_SEQUENCE))
    assert len(imported) > len(set(entry_points)) == len(entry_points) > 10
    assert not any(imported.values()), 'an import does not compile'
    assert all(constructed[name] for name in entry_points)
    assert final == constructed, 'no frame waits for the compiler'


CALLER = """
from {package}.numba_utils import compiled
from {package}.callee import scaled

@compiled
def run(x):
    return scaled(x) + 1.0
"""
CALLEE = """
from {package}.numba_utils import compiled

@compiled
def scaled(x):
    return {factor} * x
"""


def test_machine_code_of_a_changed_callee_is_not_reused(tmp_path):
    package = tmp_path / 'compiling'
    package.mkdir()
    shutil.copy(numba_utils.__file__, package)
    (package / 'caller.py').write_text(CALLER.format(package=package.name))
    results = []
    for factor in (2.0, 3.0, 3.0):
        (package / 'callee.py').write_text(CALLEE.format(package=package.name, factor=factor))
        results.append(run_script('from compiling.caller import run; print(run(1.0), '
                                  'sum(run.stats.cache_hits.values()))', tmp_path).split())
    assert results == [['3.0', '0'], ['4.0', '0'], ['4.0', '1']]


def test_entry_points_are_loaded_from_the_cache(tmp_path):
    package = tmp_path / 'compiling'
    package.mkdir()
    shutil.copy(numba_utils.__file__, package)
    script = ('from compiling import numba_utils as utils; utils.compile_entry_points(); '
              'print([sum(utils.median.stats.cache_hits.values()), len(utils.median.signatures)])')
    assert [run_script(script, tmp_path).strip() for _ in range(2)] == ['[0, 1]', '[1, 1]']
