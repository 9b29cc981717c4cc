# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``benchmarks/vggt.py``: its arguments, and its parts with a small model.

The command itself takes minutes and gigabytes.
"""

from __future__ import annotations

import pytest
from vggt_models import SMALL_CONFIG, torch

from benchmarks import vggt
from benchmarks.vggt import STEPS, WindowSteps, count_flops
from kfvo_ros.backbones.vggt.model import random_model

CPU = torch.device('cpu')
FRAMES = 8


@pytest.mark.parametrize(('arguments', 'status', 'part'), [
    (['--size', '100x100'], 2, 'multiples of 14, came 100x100'),
    (['--size', '0x14'], 2, 'multiples of 14, came 0x14'),
    (['--size', 'large'], 2, 'multiples of 14, came large'),
    (['--size', '28x28x3'], 2, 'came 28x28x3'),
    (['--frames', '1'], 2, 'at least two frames'),
    (['--rounds', '0'], 2, 'one round'),
    (['--precision', 'fp8'], 2, 'fp8'),
    (['--against', 'none'], 2, 'none'),
    (['--device', 'tpu'], 1, "'tpu'")])
def test_invalid_arguments_end_in_one_line(arguments, status, part, capsys):
    try:
        ended = vggt.main(arguments)
    except SystemExit as ending:
        ended = ending.code
    line = capsys.readouterr().err.splitlines()[-1]
    assert (ended, part in line, 'error: ' in line) == (status, True, True)


@pytest.mark.parametrize('dtype', [torch.float32, torch.bfloat16])
def test_random_model(dtype):
    model = random_model(CPU, dtype, SMALL_CONFIG)
    assert model.config == SMALL_CONFIG and not model.training
    for name, each in model.named_parameters():
        assert torch.isfinite(each).all() and not each.requires_grad, name
    assert model.aggregator.frame_blocks[0].mlp.fc1.weight.dtype is dtype
    assert torch.equal(model.camera_head.token_norm.weight, torch.ones(2 * SMALL_CONFIG.width))


def test_steps_estimate_their_windows():
    torch.manual_seed(0)
    model, shape = random_model(CPU, torch.float32, SMALL_CONFIG), (42, 56, 4)
    with torch.inference_mode():
        steps = WindowSteps(model, *shape)
        first, *others, last = steps.images
        windows = {'plain': [first, *others, last], 'sliding': [*others, last, last],
                   'anchor kept': [first, *others, last]}
        for kind, step in STEPS.items():
            steps = WindowSteps(model, *shape)
            steps.images = torch.stack([first, *others, last])
            found = step(steps)
            assert found.shape == (4, 1, 4, 9)
            torch.testing.assert_close(found, model(torch.stack(windows[kind])[None]), rtol=0.0,
                                       atol=1e-5)
        official = WindowSteps(model, *shape, autocast=True)
        official.images = steps.images
        difference = (official.plain() - steps.plain()).abs().max()
    assert 0.0 < difference < 0.05


def test_times_and_shares():
    with torch.inference_mode():
        steps = WindowSteps(random_model(CPU, torch.float32, SMALL_CONFIG), 28, 28, 3)
        times = vggt._time_steps(steps, steps, 3)
        shares = vggt._time_shares(steps, 'sliding')
    assert {kind: len(seconds) for kind, seconds in times.items()} == dict.fromkeys(STEPS, 3)
    assert min(min(seconds) for seconds in times.values()) > 0.0
    assert set(shares) == {'encode', 'frame', 'head', 'global and rest'}
    assert min(shares.values()) > 0.0 and sum(shares.values()) == pytest.approx(1.0)


def test_reuse_saves_a_quarter_of_the_operations():
    plain, sliding, kept = (count_flops(step, 168, 224, FRAMES) for step in STEPS.values())
    assert list(STEPS) == ['plain', 'sliding', 'anchor kept']
    assert kept < sliding < 0.72 * plain  # a kept anchor has been computed in that role


def test_operations_at_the_published_image_size():
    plain, sliding = (count_flops(STEPS[kind], 392, 518, FRAMES) for kind in ('plain', 'sliding'))
    assert plain == pytest.approx(23.6e12, rel=0.005)
    assert sliding == pytest.approx(17.8e12, rel=0.005)
