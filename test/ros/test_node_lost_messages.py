# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images and simulated time that do not reach kfvo_node, and how it reports them."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import numpy as np
import pytest
from command_lines import run_python
from node_rig import (
    BEST_EFFORT,
    DIAGNOSTICS,
    IMAGE,
    RELIABLE,
    WARN,
    Rig,
    builtin_interfaces,
    is_origin,
    make_frames,
    rosgraph_msgs,
    sensor_msgs,
    stamp_ns,
)
from ros_processes import ENVIRONMENT, Listener, rclpy, wait_until

from kfvo_ros.trajectory import NANOSECONDS

FRAMES = make_frames()


def counts(rig: Rig, *keys: str) -> list[int]:
    """Return the node's counts of images."""
    values = rig.state()[2]
    return [int(values[f'images {key}']) for key in keys]


@pytest.mark.parametrize('qos', [RELIABLE, BEST_EFFORT], ids=['reliable', 'best_effort'])
def test_received_and_lost_images_add_up_to_those_sent(qos):
    """The node is suspended while its camera goes on: the queues before it overflow."""
    with Rig(qos=qos, process_every_frame=False) as rig:
        rig.send_until_odometry(FRAMES[:1])
        time.sleep(1.5)  # until diagnostics include them
        before = sum(counts(rig, 'lost in transit', 'received'))
        rig.process.send_signal(signal.SIGSTOP)
        rig.send(FRAMES[:30] * 4, with_info=False)
        rig.process.send_signal(signal.SIGCONT)
        for frame in FRAMES[30:]:
            rig.send([frame])
            time.sleep(0.05)
        sent = len(FRAMES[:30] * 4 + FRAMES[30:])
        wait_until(lambda: sum(counts(rig, 'lost in transit', 'received')) == before + sent)
        assert min(counts(rig, 'lost in transit', 'received')) > 10


def test_a_camera_that_stops_is_reported_and_may_restart():
    with Rig() as rig:
        rig.run(FRAMES[:3])
        rig.wait_for_value('images processed', 3)
        assert rig.state()[0] == 0
        began = time.monotonic()
        rig.stop_camera()
        wait_until(lambda: rig.state()[0] == WARN)
        assert 3.5 < time.monotonic() - began < 7.5
        assert rig.state()[1].startswith(f'no image on {IMAGE} for ')
        assert f'{IMAGE} has no publisher' in rig.wait_for_line('no image on')
        rig.start_camera()
        rig.wait_for_subscriber()
        after = rig.run(FRAMES[3:6])
        assert not is_origin(after[0])
        wait_until(lambda: rig.state()[0] == 0)
        rig.wait_for_value('images received', 6)
        assert counts(rig, 'lost in transit') == [0]  # another publisher, whose numbers start at 1


LARGE = """
import time
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
rclpy.init()
publisher = rclpy.create_node('large').create_publisher(Image, '/large', qos_profile_sensor_data)
image = Image(height=720, width=1280, step=3840, encoding='rgb8', data=bytes(720 * 3840))
while not publisher.get_subscription_count():
    time.sleep(0.02)
for index in range(60):
    image.header.stamp.sec = index
    publisher.publish(image)
    time.sleep(1 / 30)
"""


def test_large_images_arrive_from_a_camera_with_the_profile():
    """Best effort, after discovery; the default shared memory is smaller than one image."""
    if rclpy.get_rmw_implementation_identifier() != 'rmw_fastrtps_cpp':
        pytest.skip('this is not Fast DDS')
    profile = Path(__file__).parents[2] / 'config' / 'fastdds_large_images.xml'
    with Listener({'/large': sensor_msgs.Image}, BEST_EFFORT) as listener:
        done = run_python(
            '-c', LARGE, env=ENVIRONMENT | {'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile)})
        assert (done.returncode, done.stderr) == (0, '')
        wait_until(lambda: listener.messages('/large')[-1].header.stamp.sec == 59)
    received = [message.header.stamp.sec for message in listener.messages('/large')]
    assert received[-30:] == list(range(30, 60))


def test_missing_clock_is_logged_once_and_stops_nothing():
    with Rig(use_sim_time=True) as rig:
        assert len(rig.run(FRAMES[:3])) == 3
        line = rig.wait_for_line('no /clock came')
        assert '[WARN]' in line and '--clock' in line and 'use_sim_time' in line
        before = len(rig.listener.messages(DIAGNOSTICS))
        wait_until(lambda: len(rig.listener.messages(DIAGNOSTICS)) >= before + 2)
        assert stamp_ns(rig.listener.messages(DIAGNOSTICS)[-1]) == 0
        assert np.diff(rig.listener.arrivals(DIAGNOSTICS)).max() < 2.0
        clock = rig.listener.node.create_publisher(rosgraph_msgs.Clock, '/clock', 1)

        def clock_received() -> bool:
            clock.publish(rosgraph_msgs.Clock(clock=builtin_interfaces.Time(sec=70)))
            return stamp_ns(rig.listener.messages(DIAGNOSTICS)[-1]) == 70 * NANOSECONDS

        wait_until(clock_received)
        assert sum('/clock' in line for line in rig.lines) == 1
