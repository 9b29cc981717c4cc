# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What does not reach kfvo_node, whether images or the time, and how it tells."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
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

from kfvo_ros.ros.subscriptions import QosMatchingSubscription
from kfvo_ros.trajectory import NANOSECONDS

FRAMES = make_frames()


def counted(rig: Rig, *keys: str) -> list[int]:
    """Return what the node counted of its images."""
    values = rig.state()[2]
    return [int(values[f'images {key}']) for key in keys]


@pytest.mark.parametrize('qos', [RELIABLE, BEST_EFFORT], ids=['reliable', 'best_effort'])
def test_every_image_is_counted_also_those_that_never_came(qos):
    """The node is held up while its camera goes on: the queues before it run over."""
    with Rig(qos=qos, process_every_frame=False) as rig:
        rig.send_until_heard(FRAMES[:1])
        time.sleep(1.5)  # until diagnostics tell
        before = sum(counted(rig, 'lost in transit', 'received'))
        rig.process.send_signal(signal.SIGSTOP)
        rig.send(FRAMES[:30] * 4, with_info=False)
        rig.process.send_signal(signal.SIGCONT)
        for frame in FRAMES[30:]:
            rig.send([frame])
            time.sleep(0.05)
        sent = len(FRAMES[:30] * 4 + FRAMES[30:])
        wait_until(lambda: sum(counted(rig, 'lost in transit', 'received')) == before + sent)
        assert min(counted(rig, 'lost in transit', 'received')) > 10


def test_a_camera_that_stops_is_missed_and_welcome_again():
    with Rig() as rig:
        rig.drive(FRAMES[:3])
        rig.wait_for_value('images processed', 3)
        assert rig.state()[0] == 0
        began = time.monotonic()
        rig.stop_camera()
        wait_until(lambda: rig.state()[0] == WARN)
        assert 3.5 < time.monotonic() - began < 7.5
        assert rig.state()[1].startswith(f'no image on {IMAGE} for ')
        assert f'nobody publishes {IMAGE}' in rig.wait_for_line('no image on')
        rig.start_camera()
        rig.wait_for_subscriber()
        after = rig.drive(FRAMES[3:6])
        assert not is_origin(after[0])
        wait_until(lambda: rig.state()[0] == 0)
        rig.wait_for_value('images received', 6)
        assert counted(rig, 'lost in transit') == [0]  # another publisher, which begins at 1


def test_what_cameras_sent_before_they_were_found_is_not_lost():
    """Two of them, whose images bear different numbers by then."""
    heard = []
    with Listener({}) as ours, Listener({}) as theirs:
        first, second = (theirs.node.create_publisher(sensor_msgs.Image, IMAGE, RELIABLE)
                         for _ in range(2))
        for _ in range(100):
            second.publish(sensor_msgs.Image())
        following = QosMatchingSubscription(ours.node, sensor_msgs.Image, IMAGE, 100, heard.append, 'reliable')
        for camera in (first, second):
            wait_until(camera.get_subscription_count)
        for count, camera in enumerate((first, second) * 3, 1):
            camera.publish(sensor_msgs.Image())
            wait_until(lambda count=count: len(heard) == count)
        assert following.lost == 0


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


def test_large_images_arrive_from_a_camera_that_has_the_profile():
    """By best effort, once each knows of the other; by default there is no room for one."""
    if rclpy.get_rmw_implementation_identifier() != 'rmw_fastrtps_cpp':
        pytest.skip('this is not Fast DDS')
    profile = Path(__file__).parents[2] / 'config' / 'fastdds_large_images.xml'
    with Listener({'/large': sensor_msgs.Image}, BEST_EFFORT) as listener:
        done = subprocess.run(
            [sys.executable, '-c', LARGE], text=True, capture_output=True, timeout=30.0,
            env=ENVIRONMENT | {'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile)})
        assert (done.returncode, done.stderr) == (0, '')
        wait_until(lambda: listener.messages('/large')[-1].header.stamp.sec == 59)
    came = [message.header.stamp.sec for message in listener.messages('/large')]
    assert came[-30:] == list(range(30, 60))


def test_simulated_time_that_never_begins_is_told_once_and_stops_nothing():
    with Rig(use_sim_time=True) as rig:
        assert len(rig.drive(FRAMES[:3])) == 3
        line = rig.wait_for_line('no /clock came')
        assert '[WARN]' in line and '--clock' in line and 'use_sim_time' in line
        before = len(rig.listener.messages(DIAGNOSTICS))
        wait_until(lambda: len(rig.listener.messages(DIAGNOSTICS)) >= before + 2)
        told = rig.listener.messages(DIAGNOSTICS)[-1]
        assert stamp_ns(told) == 0
        assert np.diff(rig.listener.arrivals(DIAGNOSTICS)).max() < 2.0
        clock = rig.listener.node.create_publisher(rosgraph_msgs.Clock, '/clock', 1)

        def is_heard() -> bool:
            clock.publish(rosgraph_msgs.Clock(clock=builtin_interfaces.Time(sec=70)))
            return stamp_ns(rig.listener.messages(DIAGNOSTICS)[-1]) == 70 * NANOSECONDS

        wait_until(is_heard)
        assert sum('/clock' in line for line in rig.lines) == 1
