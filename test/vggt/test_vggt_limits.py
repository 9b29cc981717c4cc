# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the VGGT backbone cannot do, each told in one line: devices, sizes, memory."""

from __future__ import annotations

import copy
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from command_lines import run_python
from vggt_models import WIDTH, changed, frames_seen, small_model, torch, window_of

from kfvo_ros.backbones.vggt.backbone import VggtBackbone, load_backbone
from kfvo_ros.backbones.vggt.runtime import (
    PRECISIONS,
    OneDnnLinear,
    choose_device,
    choose_dtype,
    use_onednn_layout,
)
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Frame

CPU = torch.device('cpu')
NO_CUDA = pytest.mark.skipif(torch.cuda.is_available(), reason='there is a CUDA device')
LINUX = pytest.mark.skipif(sys.platform != 'linux', reason='it reads /proc')
FULL = """
import ctypes, json, resource, sys
from vggt_models import changed, frames_seen, small_model, torch, window_of
from kfvo_ros.backbones.vggt.backbone import VggtBackbone
from kfvo_ros.backbones.vggt.loading import load_backbone
from kfvo_ros.backbones.vggt.packing import pack
from kfvo_ros.errors import KfvoError, MemoryFullError

def bounded(step, spare):
    used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + spare, resource.RLIM_INFINITY))
    try:
        return step()
    except KfvoError as error:
        told.append([str(error), repr(error.__cause__), isinstance(error, MemoryFullError)])
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)

M_MMAP_THRESHOLD = -3
ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, 1 << 16)  # What is freed is gone, not to be had again.
told, MiB = [], 1 << 20
torch.set_num_threads(1)
backbone, half = (VggtBackbone(changed(small_model(), dtype), 518)
                  for dtype in (torch.float32, torch.bfloat16))
frames = frames_seen(3)
window = window_of(backbone, frames)
large = VggtBackbone(small_model(), 4200)
packed = VggtBackbone(pack(changed(small_model(), torch.float32)), 518)
backbone.estimate([window])  # What oneDNN once could not make, it refuses from then on.
bounded(lambda: large.open(None).encode(frames[0]), 90 * MiB)
bounded(lambda: backbone.estimate([window]), 2 * MiB)
bounded(lambda: half.open(None).encode(frames[0]), 1 * MiB)
bounded(lambda: packed.estimate([window]), 2 * MiB)
bounded(lambda: load_backbone(sys.argv[1], None, 'cpu', 'fp32', 518, True, 8), 1 * MiB)
assert backbone.estimate([window])[0].T_anchor_frame.shape == (3, 4, 4)
print(json.dumps(told))
"""
"""Takes away the address space in earnest, and gives it back."""


@LINUX
def test_memory_that_ends_is_told_with_the_remedy(small_vggt):
    done = run_python('-c', 'import sys; sys.path.insert(0, sys.argv.pop(1))\n' + FULL,
                      Path(__file__).parent, small_vggt)
    assert done.returncode == 0, done.stderr
    *computing, reading = json.loads(done.stdout)
    assert [line for line, _, is_memory in computing if is_memory] == 4 * [
        'the memory of cpu is full: make window_size or image_width smaller, or set precision to '
        'bf16']
    assert "can't allocate memory" in computing[1][1]
    assert 'memory' in reading[0]


def test_other_mistakes_are_not_taken_for_full_memory():
    backbone = VggtBackbone(small_model(), WIDTH)
    window = window_of(backbone, frames_seen(2))
    window.frames[0].payload.patches = torch.zeros(1, 20, 7)
    with pytest.raises(RuntimeError):
        backbone.estimate([window])


@NO_CUDA
@pytest.mark.parametrize('device', ['cuda', 'cuda:0', 'cuda:3'])
def test_cuda_where_there_is_none(device, small_vggt):
    with pytest.raises(KfvoError, match=f'{device} was asked for.* 0 CUDA .*set device to cpu'):
        load_backbone(str(small_vggt), None, device, 'auto', 518, True, 8)


@pytest.mark.parametrize('device', ['nonsense', '', 'cuda:-1', 'cuda:x', 'meta', 'mps', 'CPU'])
def test_devices_that_are_none(device):
    with pytest.raises(KfvoError, match=f"auto, cpu, cuda or cuda:N, came '{device}'"):
        choose_device(device)


@LINUX
def test_what_auto_is():
    assert choose_device('cpu') == CPU
    if not torch.cuda.is_available():
        assert choose_device('auto') == CPU
    flags = re.search(r'^(?:flags|Features)\s*:(.*)$', Path('/proc/cpuinfo').read_text(), re.M)
    fast = {'avx512_bf16', 'amx_bf16', 'bf16'} & set(flags[1].split())
    assert choose_dtype('auto', CPU) is (torch.bfloat16 if fast else torch.float32)
    assert {name: choose_dtype(name, CPU) for name in PRECISIONS} == PRECISIONS


@pytest.mark.parametrize('precision', PRECISIONS)
def test_every_precision_works(precision):
    backbone = VggtBackbone(changed(small_model(), PRECISIONS[precision]), WIDTH)
    exact = VggtBackbone(small_model(), WIDTH)
    found, right = (each.estimate([window_of(each, frames_seen(4))])[0].T_anchor_frame
                    for each in (backbone, exact))
    difference = np.abs(found - right).max()
    assert difference == 0.0 if precision == 'fp32' else 1e-5 < difference < 3e-2
    assert backbone.condition() == {
        'device': 'cpu', 'precision': {'fp32': 'float32', 'bf16': 'bfloat16',
                                       'fp16': 'float16'}[precision]}


@pytest.mark.parametrize('precision', PRECISIONS)
def test_matrices_as_the_processor_likes_them_give_the_same(precision):
    exact = changed(small_model(), PRECISIONS[precision])
    packed = use_onednn_layout(copy.deepcopy(exact))
    if precision == 'fp32':
        kinds = {type(module) for module in packed.modules()}
        assert (OneDnnLinear in kinds) == torch.backends.mkldnn.is_available()
    found, right = (backbone.encodings([window_of(backbone, frames_seen(4))]) for backbone in (
        VggtBackbone(packed, WIDTH), VggtBackbone(exact, WIDTH)))
    assert np.abs(found - right).max() < (5e-6 if precision == 'fp32' else 2e-2)
    plain = VggtBackbone(packed, WIDTH, reuse=False)
    again = plain.encodings([window_of(plain, frames_seen(4))])
    assert np.abs(again - found).max() < (5e-6 if precision == 'fp32' else 2e-2)


@pytest.mark.parametrize('width', [0, -14, 13, 500, 519])
def test_widths_that_are_no_whole_patches(width, small_vggt):
    with pytest.raises(KfvoError, match=f'image_width as a multiple of 14, came {width}'):
        load_backbone(str(small_vggt), None, 'cpu', 'fp32', width, True, 8)


@pytest.mark.parametrize(('height', 'width'), [(1, 200), (2, 300)])
def test_images_smaller_than_a_patch(height, width):
    stream = VggtBackbone(small_model(), 140).open(None)
    with pytest.raises(KfvoError, match=f'at least 14 pixels high .*{width}x{height} came'):
        stream.encode(Frame(1, np.zeros((height, width), dtype=np.uint8), None))


@pytest.mark.parametrize(('height', 'width'), [(1, 1), (9, 5), (14, 140), (16, 200)])
def test_the_smallest_images_that_are_taken(height, width):
    backbone = VggtBackbone(small_model(), 140)
    rng = np.random.default_rng(0)
    frames = [Frame(index, rng.integers(0, 256, (height, width), dtype=np.uint8), None)
              for index in range(2)]
    assert np.isfinite(backbone.estimate([window_of(backbone, frames)])[0].T_anchor_frame).all()
