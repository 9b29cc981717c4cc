# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Devices, precisions, weight layout, compilation and full memory."""

from __future__ import annotations

import copy
import json
import re
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from command_lines import ENVIRONMENT, assert_one_readable_line, run_python
from vggt_models import (
    WIDTH,
    make_window,
    needs_compiler,
    noise_frames,
    small_model,
    torch,
    with_precision,
)

from kfvo_ros.backbones.base import Window
from kfvo_ros.backbones.vggt.backbone import VggtBackbone, load_backbone
from kfvo_ros.backbones.vggt.runtime import (
    PRECISIONS,
    OneDnnLinear,
    choose_device,
    choose_dtype,
    use_onednn_layout,
)
from kfvo_ros.errors import KfvoError

CPU = torch.device('cpu')
SIZE = 4
"""Largest window of the compiled backbone."""
NO_CUDA = pytest.mark.skipif(torch.cuda.is_available(), reason='there is a CUDA device')
LINUX = pytest.mark.skipif(sys.platform != 'linux', reason='it reads /proc')
LIMITED_MEMORY = """
import ctypes, json, resource, sys
from vggt_models import with_precision, noise_frames, small_model, torch, make_window
from kfvo_ros.backbones.vggt.backbone import VggtBackbone, load_backbone
from kfvo_ros.backbones.vggt.runtime import use_onednn_layout
from kfvo_ros.errors import KfvoError, MemoryFullError

def limited(step, spare):
    used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + spare, resource.RLIM_INFINITY))
    try:
        return step()
    except KfvoError as error:
        errors.append([str(error), repr(error.__cause__), isinstance(error, MemoryFullError)])
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)

M_MMAP_THRESHOLD = -3
ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, 1 << 16)  # Freed memory returns to the system.
errors, MiB = [], 1 << 20
torch.set_num_threads(1)
backbone, half = (VggtBackbone(with_precision(small_model(), dtype), 518)
                  for dtype in (torch.float32, torch.bfloat16))
frames = noise_frames(3)
window = make_window(backbone, frames)
large = VggtBackbone(small_model(), 4200)
packed = VggtBackbone(use_onednn_layout(with_precision(small_model(), torch.float32)), 518)
backbone.estimate([window])  # oneDNN remembers failures: let it succeed first.
limited(lambda: large.open(None).encode(frames[0]), 90 * MiB)
limited(lambda: backbone.estimate([window]), 2 * MiB)
limited(lambda: half.open(None).encode(frames[0]), 1 * MiB)
limited(lambda: packed.estimate([window]), 2 * MiB)
limited(lambda: load_backbone(sys.argv[1], None, 'cpu', 'fp32', 518, True, 8), 1 * MiB)
assert backbone.estimate([window])[0].T_anchor_frame.shape == (3, 4, 4)
print(json.dumps(errors))
"""
"""Limits the address space of its process, and lifts the limit again."""


@LINUX
def test_full_memory_is_reported_with_remedies(small_vggt):
    done = run_python('-c', 'import sys; sys.path.insert(0, sys.argv.pop(1))\n' + LIMITED_MEMORY,
                      Path(__file__).parents[1], small_vggt)
    assert done.returncode == 0, done.stderr
    *computing, reading = json.loads(done.stdout)
    assert [line for line, _, is_memory in computing if is_memory] == 4 * [
        'the memory of cpu is full: make window_size or image_width smaller, or set precision to '
        'bf16']
    assert "can't allocate memory" in computing[1][1]
    assert 'memory' in reading[0]


def test_other_errors_are_not_reported_as_full_memory():
    backbone = VggtBackbone(small_model(), WIDTH)
    window = make_window(backbone, noise_frames(2))
    window.frames[0].payload.patches = torch.zeros(1, 20, 7)
    with pytest.raises(RuntimeError):
        backbone.estimate([window])


@NO_CUDA
@pytest.mark.parametrize('device', ['cuda', 'cuda:0', 'cuda:3'])
def test_cuda_is_refused_without_a_gpu(device, small_vggt):
    with pytest.raises(KfvoError, match=f'{device} was asked for.* 0 CUDA .*set device to cpu'):
        load_backbone(str(small_vggt), None, device, 'auto', 518, True, 8)


@pytest.mark.parametrize('device', ['nonsense', '', 'cuda:-1', 'cuda:x', 'meta', 'mps', 'CPU'])
def test_invalid_devices_are_refused(device):
    with pytest.raises(KfvoError, match=f"auto, cpu, cuda or cuda:N, came '{device}'"):
        choose_device(device)


@LINUX
def test_auto_chooses_device_and_precision():
    assert choose_device('cpu') == CPU
    if not torch.cuda.is_available():
        assert choose_device('auto') == CPU
    flags = re.search(r'^(?:flags|Features)\s*:(.*)$', Path('/proc/cpuinfo').read_text(), re.M)
    fast = {'avx512_bf16', 'amx_bf16', 'bf16'} & set(flags[1].split())
    assert choose_dtype('auto', CPU) is (torch.bfloat16 if fast else torch.float32)
    assert {name: choose_dtype(name, CPU) for name in PRECISIONS} == PRECISIONS


@pytest.mark.parametrize('precision', PRECISIONS)
def test_poses_of_every_precision(precision):
    backbone = VggtBackbone(with_precision(small_model(), PRECISIONS[precision]), WIDTH)
    exact = VggtBackbone(small_model(), WIDTH)
    found, expected = (each.estimate([make_window(each, noise_frames(4))])[0].T_anchor_frame
                    for each in (backbone, exact))
    difference = np.abs(found - expected).max()
    assert difference == 0.0 if precision == 'fp32' else 1e-5 < difference < 3e-2
    assert backbone.device_info() == {
        'device': 'cpu', 'precision': {'fp32': 'float32', 'bf16': 'bfloat16',
                                       'fp16': 'float16'}[precision]}


@pytest.mark.parametrize('precision', PRECISIONS)
def test_onednn_layout_gives_the_same_poses(precision):
    exact = with_precision(small_model(), PRECISIONS[precision])
    packed = use_onednn_layout(copy.deepcopy(exact))
    if precision == 'fp32':
        kinds = {type(module) for module in packed.modules()}
        assert (OneDnnLinear in kinds) == torch.backends.mkldnn.is_available()
    found, expected = (
        backbone.pose_encodings([make_window(backbone, noise_frames(4))])
        for backbone in (VggtBackbone(packed, WIDTH), VggtBackbone(exact, WIDTH)))
    assert np.abs(found - expected).max() < (5e-6 if precision == 'fp32' else 2e-2)
    plain = VggtBackbone(packed, WIDTH, reuse=False)
    again = plain.pose_encodings([make_window(plain, noise_frames(4))])
    assert np.abs(again - found).max() < (5e-6 if precision == 'fp32' else 2e-2)


# Compilation


@pytest.fixture(scope='module')
def backbones(small_vggt) -> dict[bool, VggtBackbone]:
    """Backbones by whether they are compiled."""
    return {compiled: load_backbone(str(small_vggt), None, 'cpu', 'fp32', WIDTH, True, SIZE,
                                    compiled) for compiled in (True, False)}


def count_graphs() -> int:
    """Return the number of graphs compiled so far."""
    return torch._dynamo.utils.counters['stats']['unique_graphs']


def sliding_pose_encodings(backbone: VggtBackbone, height: int, batch: int) -> list[np.ndarray]:
    """Return pose encodings of `batch` windows that grow to SIZE, then slide."""
    frames = noise_frames(SIZE + 2, 0, height, 80)
    windows = [make_window(backbone, frames) for _ in range(batch)]
    spans = [slice(0, size) for size in range(2, SIZE + 1)] + [slice(1, SIZE + 1),
                                                               slice(2, SIZE + 2)]
    return [backbone.pose_encodings([Window(window.stream, window.frames[span])
                                     for window in windows]) for span in spans]


@needs_compiler
@pytest.mark.parametrize('batch', [1, 2])
@pytest.mark.parametrize('height', [60, 80])
def test_compilation_gives_the_same_poses(height, batch, backbones):
    for found, expected in zip(sliding_pose_encodings(backbones[True], height, batch),
                            sliding_pose_encodings(backbones[False], height, batch)):
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=5e-6)


@needs_compiler
def test_no_frame_waits_for_the_compiler(backbones):
    """Neither for another image size nor in another thread, as in the node."""
    sliding_pose_encodings(backbones[True], 80, 2)
    before, threads = count_graphs(), torch.get_num_threads()
    assert before > 0

    def work() -> None:
        # With the threads of the compiled run: a change of their number would recompile.
        torch.set_num_threads(threads)
        sliding_pose_encodings(backbones[True], 100, 1)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert count_graphs() == before


@needs_compiler
def test_without_a_compiler_the_error_says_so(small_vggt, tmp_path):
    done = run_python('-m', 'kfvo_ros.run', 'synthetic:3', '--stop', 3, '--backbone', 'vggt',
                      '--weights', small_vggt, '--device', 'cpu', '--image-width', WIDTH,
                      '--compile', '--output', tmp_path / 'out',
                      env=ENVIRONMENT | {'CXX': 'none-such',
                                         'TORCHINDUCTOR_CACHE_DIR': str(tmp_path / 'cache')})
    assert_one_readable_line(done, 'cannot compile the model', 'leave compile out')
    assert not (tmp_path / 'out').exists()
