# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions: lost messages, several publishers, and where the calibration is found."""

from __future__ import annotations

import numpy as np
import pytest
from ros_processes import Listener, wait_until

from kfvo_ros.errors import KfvoError
from kfvo_ros.ros.subscriptions import CameraSource, QosMatchingSubscription, SequenceGapCounter

sensor_msgs = pytest.importorskip('sensor_msgs.msg')
IMAGE = '/camera/image_raw'


@pytest.mark.parametrize('publishers', [1, 2, 3])
@pytest.mark.parametrize('seed', range(20))
def test_gaps_are_counted_whichever_publisher_sent_a_message(publishers, seed):
    """Each publisher's numbers start anywhere; messages do not name their publisher."""
    rng = np.random.default_rng(seed)
    streams, lost = [], 0
    for _ in range(publishers):
        received = rng.random(100) < 0.7
        received[[0, -1]] = True  # what is lost before and after these leaves no gap
        numbers = rng.choice([1, 1000]) + np.flatnonzero(received)
        lost += int((~received).sum())
        streams.append(list(map(int, numbers)))
    gaps, counted = SequenceGapCounter(), 0
    gaps.reset(publishers)
    counted += sum(gaps.missing_before(stream.pop(0)) for stream in streams)
    while any(streams):
        stream = streams[rng.choice([i for i, left in enumerate(streams) if left])]
        counted += gaps.missing_before(stream.pop(0))
    assert lost > 10 and counted == lost


def test_restarted_publishers_leave_no_gap():
    gaps = SequenceGapCounter()
    gaps.reset(1)
    assert [gaps.missing_before(number) for number in (7, 8, 11)] == [0, 0, 2]
    gaps.reset(1)  # the publisher is restarted
    assert [gaps.missing_before(number) for number in (30, 31, 33)] == [0, 0, 1]
    assert [gaps.missing_before(number) for number in (1, 2, 4)] == [0, 0, 1]  # without a reset
    gaps.reset(2)
    assert [gaps.missing_before(number) for number in (5, 500, 6, 503)] == [0, 0, 0, 2]
    assert gaps.missing_before(None) == 0


def test_messages_sent_before_discovery_are_not_counted_as_lost():
    """Two cameras, whose sequence numbers differ by then."""
    received = []
    with Listener({}) as node_side, Listener({}) as camera_side:
        first, second = (camera_side.node.create_publisher(sensor_msgs.Image, IMAGE, 1000)
                         for _ in range(2))
        for _ in range(100):
            second.publish(sensor_msgs.Image())
        subscription = QosMatchingSubscription(node_side.node, sensor_msgs.Image, IMAGE, 100,
                                               received.append, 'reliable')
        for camera in (first, second):
            wait_until(camera.get_subscription_count)
        for count, camera in enumerate((first, second) * 3, 1):
            camera.publish(sensor_msgs.Image())
            wait_until(lambda count=count: len(received) == count)
        assert subscription.lost == 0
        assert subscription.publishers() == ['/listener', '/listener']


@pytest.mark.parametrize('info', ['/front/camera_info', '/front/Scene/camera_info'])
def test_calibration_is_found_on_the_topics_that_drivers_use(info):
    with Listener({}) as node_side, Listener({}) as camera_side:
        source = CameraSource(node_side.node, '/front/Scene')
        publisher = camera_side.node.create_publisher(sensor_msgs.CameraInfo, info, 1)
        wait_until(publisher.get_subscription_count)
        publisher.publish(sensor_msgs.CameraInfo(width=640, height=480, k=[
            400.0, 0.0, 320.0, 0.0, 400.0, 240.0, 0.0, 0.0, 1.0]))
        wait_until(lambda: source.camera(640, 480))
        assert source.name == info and source.camera(320, 240).fx == 200.0
        with pytest.raises(KfvoError, match=f'CameraInfo on {info}: .* is for 640x480 images'):
            source.camera(640, 400)
