# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics: rates, latencies, levels and summaries."""

from __future__ import annotations

from types import SimpleNamespace

from ros_processes import rclpy  # noqa: F401  (skips where it is missing)

from kfvo_ros.backbones.base import Status
from kfvo_ros.ros import diagnostics as module
from kfvo_ros.ros.messages import make_header


def test_rates_and_latencies(monkeypatch):
    now = 0.0
    monkeypatch.setattr(module, 'time', SimpleNamespace(monotonic=lambda: now))
    diagnostics = module.Diagnostics()

    def values() -> dict[str, str]:
        status, = diagnostics.message(make_header(1, ''), 'name', '/image', {}).status
        return {pair.key: pair.value for pair in status.values}

    for index in range(20):
        now = 0.1 * index
        arrival = diagnostics.record_image()
        if index % 2:
            now += 1e-3 * index
            diagnostics.record_pose(arrival, Status.OK, index == 1)
    measured = values()
    assert (measured['input rate [Hz]'], measured['output rate [Hz]']) == ('10.0', '5.0')
    assert (measured['latency median [ms]'], measured['latency 95 % [ms]']) == ('10.0', '18.1')
    assert measured['keyframe ratio'] == '0.100'
    now += 6.0
    assert (values()['input rate [Hz]'], values()['output rate [Hz]']) == ('0.0', '0.0')


def level_and_summary(diagnostics: module.Diagnostics) -> tuple[int, str]:
    status, = diagnostics.message(make_header(1, ''), 'name', '/image', {}).status
    return int.from_bytes(status.level, 'little'), status.message


def test_level_and_summary(monkeypatch):
    diagnostics = module.Diagnostics()
    assert level_and_summary(diagnostics) == (0, 'waiting for the first image')
    diagnostics.record_pose(diagnostics.record_image(), Status.OK, True)
    assert level_and_summary(diagnostics) == (0, 'tracking')
    diagnostics.record_refusal('garbage')
    assert level_and_summary(diagnostics) == (1, 'garbage')
    diagnostics.record_withheld(Status.OK, 'no TF')
    assert level_and_summary(diagnostics) == (1, 'no TF')
    diagnostics.set_problem('log', 'full disk')
    assert level_and_summary(diagnostics) == (1, 'no TF; full disk')
    diagnostics.record_pose(diagnostics.record_image(), Status.LOST, False)
    assert level_and_summary(diagnostics) == (1, 'full disk; lost')
    counted = (diagnostics.received, diagnostics.processed, diagnostics.withheld)
    assert counted == (2, 2, 1)
    assert (diagnostics.keyframes, diagnostics.frames_lost) == (1, 1)
    diagnostics.set_problem('log', '')
    monkeypatch.setattr(module, 'IMAGE_TIMEOUT_S', -1.0)
    assert level_and_summary(diagnostics) == (1, 'no image on /image for 0 s; lost')
    monkeypatch.setattr(module, 'SILENCE_S', -1.0)
    assert level_and_summary(diagnostics) == (2, 'no image on /image for 0 s; lost')
    diagnostics.paused = True
    assert level_and_summary(diagnostics) == (0, 'paused')


def test_poses_that_are_not_published_are_no_output():
    diagnostics = module.Diagnostics()
    for _ in range(5):
        diagnostics.record_image()
        diagnostics.record_withheld(Status.OK, 'no transform')
    status, = diagnostics.message(make_header(1, ''), 'name', '/image', {}).status
    values = {pair.key: pair.value for pair in status.values}
    assert (values['images received'], values['images processed']) == ('5', '0')
    assert (values['poses withheld'], values['output rate [Hz]']) == ('5', '0.0')
    assert (values['keyframes'], values['state']) == ('0', 'waiting')


def test_resets_that_repeat_are_a_warning(monkeypatch):
    now = 100.0
    monkeypatch.setattr(module, 'time', SimpleNamespace(monotonic=lambda: now))
    diagnostics = module.Diagnostics()
    diagnostics.record_image()
    for requested in (False, True, True, False):
        diagnostics.record_reset(requested)
    assert level_and_summary(diagnostics)[0] == 0
    diagnostics.record_reset(requested=False)
    assert level_and_summary(diagnostics) == (1, '3 resets within 60 s')
    assert diagnostics.resets == 5
    now += 61.0
    diagnostics.record_image()
    assert level_and_summary(diagnostics)[0] == 0
