# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The VGGT model compiled by torch: the same poses, and nothing left to compile later on."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from command_lines import ENVIRONMENT, assert_one_readable_line, run_python
from vggt_models import WIDTH, frames_seen, needs_compiler, torch, window_of

from kfvo_ros.backbones.base import Window
from kfvo_ros.backbones.vggt.backbone import VggtBackbone, load_backbone

SIZE = 4
pytestmark = needs_compiler


@pytest.fixture(scope='module')
def backbones(small_vggt) -> dict[bool, VggtBackbone]:
    """Return the backbone by whether it is compiled."""
    return {compiled: load_backbone(str(small_vggt), None, 'cpu', 'fp32', WIDTH, True, SIZE,
                                    compiled) for compiled in (True, False)}


def graphs() -> int:
    """Return how many graphs were compiled so far."""
    return torch._dynamo.utils.counters['stats']['unique_graphs']


def encodings(backbone: VggtBackbone, height: int, batch: int) -> list[np.ndarray]:
    """Return pose encodings of windows that grow to SIZE and slide on, so many at a time."""
    frames = frames_seen(SIZE + 2, 0, height, 80)
    windows = [window_of(backbone, frames) for _ in range(batch)]
    spans = [slice(0, size) for size in range(2, SIZE + 1)] + [slice(1, SIZE + 1),
                                                               slice(2, SIZE + 2)]
    return [backbone.encodings([Window(window.stream, window.frames[span]) for window in windows])
            for span in spans]


@pytest.mark.parametrize('batch', [1, 2])
@pytest.mark.parametrize('height', [60, 80])
def test_the_poses_are_the_same(height, batch, backbones):
    for found, right in zip(encodings(backbones[True], height, batch),
                            encodings(backbones[False], height, batch)):
        assert found.shape == right.shape
        np.testing.assert_allclose(found, right, rtol=0.0, atol=5e-6)


def test_no_frame_waits_for_the_compiler(backbones):
    """Not of another size, and not in another thread, as in the node."""
    encodings(backbones[True], 80, 2)
    before, threads = graphs(), torch.get_num_threads()
    assert before > 0

    def work() -> None:
        """Place windows with as many threads as this one has: tests are kept to fewer."""
        torch.set_num_threads(threads)
        encodings(backbones[True], 100, 1)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert graphs() == before


def test_without_a_compiler_the_line_says_so(small_vggt, tmp_path):
    done = run_python('-m', 'kfvo_ros.run', 'synthetic:3', '--stop', 3, '--backbone', 'vggt',
                      '--weights', small_vggt, '--device', 'cpu', '--image-width', WIDTH,
                      '--compile', '--output', tmp_path / 'out',
                      env=ENVIRONMENT | {'CXX': 'none-such',
                                         'TORCHINDUCTOR_CACHE_DIR': str(tmp_path / 'cache')})
    assert_one_readable_line(done, 'cannot compile the model', 'leave compile out')
    assert not (tmp_path / 'out').exists()
