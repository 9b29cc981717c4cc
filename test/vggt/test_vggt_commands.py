# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``run --backbone vggt`` as users start it, and the parts of the benchmark."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
from command_lines import assert_one_readable_line, run_python
from vggt_models import SMALL, torch

from benchmarks import vggt
from benchmarks.vggt import STEPS, WindowSteps
from kfvo_ros.backbones.vggt.model import random_model
from kfvo_ros.trajectory import Trajectory, read_tum

COUNT, WIDTH, NATIVE_WIDTH, NATIVE_HEIGHT = 15, 140, 640, 480
CPU = torch.device('cpu')
VGGT = ('--backbone', 'vggt', '--image-width', WIDTH)

command = partial(run_python, '-m', 'kfvo_ros.run', 'synthetic:3', '--stop', COUNT, *VGGT)


@pytest.fixture(scope='module')
def outcomes(small_vggt, tmp_path_factory) -> dict[str, tuple[Trajectory, dict]]:
    """Return trajectory and summary of a run that reuses and one that does not."""
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


def test_files_and_summary(outcomes):
    trajectory, summary = outcomes['reuse']
    assert len(trajectory) == summary['frames'] == COUNT
    assert 7 <= summary['keyframes'] <= COUNT
    assert (summary['lost_frames'], summary['extent'] > 0.0) == (0, True)
    about = {'backbone': 'vggt', 'scale_rule': 'translation', 'device': 'cpu',
             'precision': 'float32', 'ground_truth_frame': 'camera'}
    assert {name: summary[name] for name in about} == about
    assert summary['median_depth'] is None  # the model tells no points
    K = summary['estimated_intrinsics']
    assert set(K) == {'fx', 'fy', 'cx', 'cy'}
    assert K['cx'] == pytest.approx(NATIVE_WIDTH / 2)
    assert K['cy'] == pytest.approx(NATIVE_HEIGHT / 2, abs=14 * NATIVE_WIDTH / WIDTH)
    assert K['fx'] > 10.0


def test_recomputing_gives_the_same_trajectory(outcomes):
    (reused, _), (anew, summary) = outcomes['reuse'], outcomes['recompute']
    assert summary['keyframes'] == outcomes['reuse'][1]['keyframes']
    np.testing.assert_allclose(reused.poses, anew.poses, atol=1e-4)
    assert np.abs(anew.poses - anew.poses[0]).max() > 0.01


@pytest.mark.parametrize(('arguments', 'parts'), [
    (['--precision', 'fp8'], ['fp8', 'bf16']),
    (['--image-width', '7'], ['at least 14'])])
def test_what_cannot_be_is_told_in_one_line(arguments, parts, small_vggt, tmp_path):
    done = command('--weights', small_vggt, '--output', tmp_path / 'out', *arguments)
    assert_one_readable_line(done, *parts)
    assert not (tmp_path / 'out').exists()


def test_without_torch_the_line_says_what_to_install(tmp_path):
    script = ("import sys; sys.modules['torch'] = None; "
              'from kfvo_ros.run import main; sys.exit(main())')
    done = run_python('-c', script, 'synthetic:3', *VGGT, '--output', tmp_path / 'out')
    assert_one_readable_line(done, 'torch is missing: pip install torch')


# The benchmark: at full size it takes minutes and gigabytes, so here are its parts


@pytest.mark.usefixtures('own_signals')
@pytest.mark.parametrize(('arguments', 'status', 'part'), [
    (['--size', '100x100'], 2, 'multiples of 14, came 100x100'),
    (['--size', '0x14'], 2, 'multiples of 14, came 0x14'),
    (['--size', 'large'], 2, 'large'),
    (['--frames', '1'], 2, 'at least two frames'),
    (['--rounds', '0'], 2, 'one round'),
    (['--precision', 'fp8'], 2, 'fp8'),
    (['--against', 'nobody'], 2, 'nobody'),
    (['--device', 'tpu'], 1, "'tpu'")])
def test_the_benchmark_refuses_in_one_line(arguments, status, part, capsys):
    try:
        ended = vggt.main(arguments)
    except SystemExit as ending:
        ended = ending.code
    line = capsys.readouterr().err.splitlines()[-1]
    assert (ended, part in line, 'error: ' in line) == (status, True, True)


@pytest.mark.parametrize('dtype', [torch.float32, torch.bfloat16])
def test_random_model(dtype):
    model = random_model(CPU, dtype, SMALL)
    assert model.config == SMALL and not model.training
    for name, each in model.named_parameters():
        assert torch.isfinite(each).all() and not each.requires_grad, name
    assert model.aggregator.frame_blocks[0].mlp.fc1.weight.dtype is dtype
    assert torch.equal(model.camera_head.token_norm.weight, torch.ones(2 * SMALL.width))


def test_steps_of_the_benchmark_place_their_windows():
    torch.manual_seed(0)
    model, shape = random_model(CPU, torch.float32, SMALL), (42, 56, 4)
    with torch.inference_mode():
        scene = WindowSteps(model, *shape)
        first, *others, last = scene.images
        windows = {'plain': [first, *others, last], 'sliding': [*others, last, last],
                   'anchor kept': [first, *others, last]}
        for kind, step in STEPS.items():
            scene = WindowSteps(model, *shape)
            scene.images = torch.stack([first, *others, last])
            found = step(scene)
            assert found.shape == (4, 1, 4, 9)
            torch.testing.assert_close(found, model(torch.stack(windows[kind])[None]), rtol=0.0,
                                       atol=1e-5)
        official = WindowSteps(model, *shape, autocast=True)
        official.images = scene.images
        difference = (official.plain() - scene.plain()).abs().max()
    assert 0.0 < difference < 0.05


def test_times_and_shares_of_the_benchmark():
    with torch.inference_mode():
        scene = WindowSteps(random_model(CPU, torch.float32, SMALL), 28, 28, 3)
        times = vggt._time(scene, scene, 3)
        shares = vggt._shares(scene, 'sliding')
    assert {kind: len(seconds) for kind, seconds in times.items()} == dict.fromkeys(STEPS, 3)
    assert min(min(seconds) for seconds in times.values()) > 0.0
    assert set(shares) == {'encode', 'frame', 'head', 'global and rest'}
    assert min(shares.values()) > 0.0 and sum(shares.values()) == pytest.approx(1.0)
