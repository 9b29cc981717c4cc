# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test when kernels are compiled."""

from __future__ import annotations

import json
import textwrap

from command_lines import run_python

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


def test_kernels_are_compiled_for_all_calls_when_a_backbone_is_constructed():
    done = run_python('-c', textwrap.dedent(SIGNATURES_DURING_A_SEQUENCE))
    assert done.returncode == 0, done.stderr
    imported, constructed, final, entry_points = json.loads(done.stdout)
    assert len(imported) > len(set(entry_points)) == len(entry_points) > 10
    assert not any(imported.values()), 'an import does not compile'
    assert all(constructed[name] for name in entry_points)
    assert final == constructed, 'no frame waits for the compiler'
