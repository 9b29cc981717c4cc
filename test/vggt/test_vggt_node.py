# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``kfvo_node`` with backbone:=vggt, fed over DDS from another process."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from node_rig import NODE, Rig, make_frames, stamp_ns, to_image, to_pose
from ros_processes import ENVIRONMENT, run_module
from vggt_models import WIDTH, needs_compiler

from kfvo_ros.odometry.base_motion import T_BODY_OPTICAL, base_pose
from kfvo_ros.odometry.factory import make_backbone, make_odometry
from kfvo_ros.odometry.options import OdometryOptions, VggtOptions

COUNT = 12
SLACK = 4 << 20
"""Memory beyond the model's own, too small for the activations at this image size [bytes]."""
FRAMES = make_frames()[:COUNT]


@pytest.fixture(scope='module')
def run(small_vggt) -> SimpleNamespace:
    """Output of a node for images without calibration, then for smaller ones."""
    with Rig(backbone='vggt', weights=small_vggt, image_width=WIDTH, precision='fp32',
             device='cpu') as rig:
        rig.send(FRAMES, with_info=False)
        messages = rig.odometry(COUNT)
        rig.wait_for_value('images processed', COUNT)
        state = rig.state()
        for frame in FRAMES[:3]:
            rig.image.publish(to_image(frame.stamp_ns + FRAMES[-1].stamp_ns,
                                       frame.image[::2, ::2]))
        later = rig.odometry(COUNT + 3)[COUNT:]
        rig.wait_for_value('resets', 1)
        rig.stop()
    return SimpleNamespace(messages=messages, state=state, later=later, lines=rig.lines,
                           code=rig.process.returncode)


def test_poses_equal_those_of_the_odometry_offline(run, small_vggt):
    options = OdometryOptions(backbone='vggt')
    odometry = make_odometry(options, make_backbone(options, VggtOptions(
        weights=str(small_vggt), device='cpu', precision='fp32', image_width=WIDTH)))
    assert [stamp_ns(message) for message in run.messages] == [f.stamp_ns for f in FRAMES]
    for message, frame in zip(run.messages, FRAMES, strict=True):
        pose = odometry.process(frame).T_world_camera
        np.testing.assert_allclose(to_pose(message.pose.pose), base_pose(pose, T_BODY_OPTICAL),
                                   atol=1e-4)
    assert np.abs(to_pose(run.messages[-1].pose.pose) - np.eye(4)).max() > 0.01


def test_covariances_are_positive_definite(run):
    for message in run.messages:
        covariance = np.reshape(message.pose.covariance, (6, 6))
        assert np.linalg.eigvalsh(covariance)[0] > 0.0


def test_diagnostics_show_device_precision_and_camera(run):
    level, summary, values = run.state
    assert (level, summary) == (0, 'tracking')
    assert (values['backbone'], values['device'], values['precision']) == (
        'vggt', 'cpu', 'float32')
    fx, fy = map(float, values['focal lengths as estimated [px]'].split())
    assert fx > 0.0 and fy > 0.0
    assert (values['images refused'], values['resets'], values['frames lost']) == ('0', '0', '0')


def test_another_image_size_restarts(run):
    assert any('restarting' in line and 'another size' in line for line in run.lines)
    assert len(run.later) == 3
    np.testing.assert_allclose(to_pose(run.later[0].pose.pose), np.eye(4), atol=1e-12)
    assert run.code == 0
    assert not [line for line in run.lines if '[ERROR]' in line or 'Traceback' in line]


@needs_compiler
def test_no_frame_waits_for_the_compiler(run, small_vggt, monkeypatch):
    """torch logs all compilations but the first; every kind of block causes further ones."""
    monkeypatch.setitem(ENVIRONMENT, 'TORCH_LOGS', 'recompiles')
    with Rig(backbone='vggt', weights=small_vggt, image_width=WIDTH, precision='fp32',
             device='cpu', compile=True, timeout_s=120.0) as rig:
        rig.send(FRAMES, with_info=False)
        messages = rig.odometry(COUNT)
        rig.stop()
    ready = next(number for number, line in enumerate(rig.lines) if 'ready' in line)
    assert any('Recompiling' in line for line in rig.lines[:ready])
    assert not any('Recompiling' in line for line in rig.lines[ready:])
    for message, expected in zip(messages, run.messages, strict=True):
        np.testing.assert_allclose(to_pose(message.pose.pose), to_pose(expected.pose.pose),
                                   atol=1e-4)


@pytest.mark.skipif(sys.platform != 'linux', reason='only Linux lets us limit another process')
def test_full_memory_is_reported_once_and_survived(small_vggt):
    """Images are refused while memory is full; processing resumes afterwards."""
    with Rig(backbone='vggt', weights=small_vggt, image_width=1120, precision='fp32',
             device='cpu') as rig:
        def limit(size: int) -> None:
            resource.prlimit(rig.process.pid, resource.RLIMIT_AS, (size, resource.RLIM_INFINITY))

        rig.send(FRAMES[:1], with_info=False)
        rig.odometry(1)
        pages = int(Path(f'/proc/{rig.process.pid}/statm').read_text().split()[0])
        limit(pages * resource.getpagesize() + SLACK)
        rig.send(FRAMES[1:4], with_info=False)
        rig.wait_for_value('images refused', 3)
        level, summary, _ = rig.state()
        limit(resource.RLIM_INFINITY)
        rig.send(FRAMES[4:5], with_info=False)
        rig.odometry(2)
        rig.stop()
    assert level == 1 and 'the memory of cpu is full: make window_size' in summary
    assert len([line for line in rig.lines if 'memory of cpu is full' in line]) == 1
    assert [stamp_ns(message) for message in rig.odometry()] == [
        FRAMES[0].stamp_ns, FRAMES[4].stamp_ns]


@pytest.mark.parametrize(('parameters', 'parts'), [
    (['weights:=/no/such.safetensors'], ['no file of weights', '/no/such.safetensors']),
    (['precision:=fp8'], ['precision', "'fp8'"])])
def test_invalid_parameters_end_the_node_in_one_line(parameters, parts, small_vggt):
    arguments = ['backbone:=vggt', f'weights:={small_vggt}', *parameters]
    done = run_module(NODE, '--ros-args', *(word for each in arguments for word in ('-p', each)))
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    line, = [line for line in done.stderr.splitlines() if 'error:' in line]
    assert all(part in line for part in parts), line
