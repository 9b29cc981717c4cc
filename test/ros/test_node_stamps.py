# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps of the images of kfvo_node: late, odd, zero, of several cameras."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from node_rig import (
    WARN,
    Rig,
    is_origin,
    make_frames,
    sensor_msgs,
    stamp_ns,
    to_image,
)
from ros_processes import wait_until

from kfvo_ros.sequences.base import Frame
from kfvo_ros.trajectory import NANOSECONDS

START_NS = 1_000 * NANOSECONDS
FRAMES = [Frame(frame.stamp_ns + START_NS, frame.image, frame.camera) for frame in make_frames()]
STAMPS_NS = [frame.stamp_ns for frame in FRAMES]


@pytest.fixture(scope='module')
def rig() -> Iterator[Rig]:
    """Yield a node for tests that start with a reset."""
    with Rig() as rig:
        yield rig


def with_stamps(stamps_ns: list[int]) -> list[Frame]:
    """Return the first frames with other stamps."""
    return [Frame(stamp, frame.image, frame.camera)
            for stamp, frame in zip(stamps_ns, FRAMES, strict=False)]


def counts(rig: Rig) -> list[int]:
    values = rig.state()[2]
    return [int(values[key]) for key in ('resets', 'images late', 'images with an odd stamp')]


@pytest.mark.parametrize(('position', 'stamp', 'expected'), [
    (8, STAMPS_NS[6] + 1, (0, 1, 0)), (8, 0, (0, 0, 1)),
    (8, STAMPS_NS[8] + 3600 * NANOSECONDS, (0, 0, 1)), (8, STAMPS_NS[7], (0, 1, 0))],
    ids=['late', 'zero', 'ahead', 'equal'])
def test_a_single_odd_stamp_is_left_out_and_counted(rig, position, stamp, expected):
    rig.reset()
    before = counts(rig)
    stamps = STAMPS_NS[:14]
    stamps[position] = stamp
    rig.send(with_stamps(stamps))
    messages = rig.odometry(13)
    assert [stamp_ns(message) for message in messages] == [
        each for index, each in enumerate(STAMPS_NS[:14]) if index != position]
    assert [is_origin(message) for message in messages] == [True] + [False] * 12
    wait_until(lambda: [after - first for after, first in
                        zip(counts(rig), before, strict=True)] == list(expected))
    rig.wait_for_line('left out the image of stamp')


def test_a_clock_that_goes_back_resets_once_and_loses_no_image(rig):
    rig.reset()
    before = counts(rig)
    messages = rig.run(FRAMES[:10])
    rig.send(with_stamps(STAMPS_NS[:6]))
    messages = rig.odometry(16)
    assert [stamp_ns(message) for message in messages] == STAMPS_NS[:10] + STAMPS_NS[:6]
    assert [index for index, message in enumerate(messages) if is_origin(message)] == [0, 10]
    wait_until(lambda: counts(rig) == [before[0] + 1, *before[1:]])


def test_two_cameras_on_one_topic_are_a_warning_and_no_resets(rig):
    """The second camera publishes the same times a little later, as a mirrored driver does."""
    rig.reset()
    before = counts(rig)
    second = rig.listener.node.create_publisher(sensor_msgs.Image, rig._topic, rig._qos)
    try:
        rig.wait_for_line('2 publishers on /camera/image_raw, of /listener, /listener: expected')
        wait_until(lambda: '2 publishers on /camera/image_raw' in rig.state()[1])
        assert rig.state()[0] == WARN
        wait_until(second.get_subscription_count)
        for frame, other in zip(FRAMES[1:13], FRAMES[:12], strict=True):
            rig.send([frame])
            time.sleep(0.02)
            second.publish(to_image(other.stamp_ns + 1, other.image))
            time.sleep(0.02)
        rig.odometry(12)
        wait_until(lambda: sum(counts(rig)[1:]) >= sum(before[1:]) + 11)
        assert counts(rig)[0] == before[0]
        assert sum(map(is_origin, rig.odometry())) == 1
    finally:
        rig.listener.node.destroy_publisher(second)
    wait_until(lambda: 'publishers' not in rig.state()[1])


def test_stamps_of_zero_are_replaced_by_arrival(rig):
    rig.reset()
    began_ns = time.time_ns()
    for frame in with_stamps([0] * 8):
        rig.send([frame])
        time.sleep(0.02)
    messages = rig.odometry(8)
    stamps = [stamp_ns(message) for message in messages]
    assert stamps == sorted(set(stamps)) and began_ns < stamps[0] < time.time_ns()
    assert [is_origin(message) for message in messages] == [True] + [False] * 7
    lines = [line for line in rig.lines if 'the stamps of the images are zero' in line]
    assert len(lines) == 1 and '[WARN]' in lines[0]
