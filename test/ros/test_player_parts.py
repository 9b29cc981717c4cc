# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the player is made of, as far as it knows no ROS: reading, reading ahead, pacing."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from itertools import count, islice
from pathlib import Path

import numpy as np
import pytest
from bag_writers import POSES, STAMPS_NS, START_NS, BagWriter, images, truth_records
from rosbags.typesys import Stores, get_typestore

import kfvo_ros
from kfvo_ros.ros.player import PlaybackClock
from kfvo_ros.ros.worker import ReadAhead
from kfvo_ros.sequences.bag.reader import Bag, Delivery

FOREVER = 2 ** 62
ROS2 = get_typestore(Stores.ROS2_JAZZY)


def test_ros1_messages_become_those_of_ros2(tmp_path):
    """Byte for byte what a writer of ROS 2 would have recorded."""
    raw = {}
    for storage in ('ros1', 'mcap'):
        writer = BagWriter(storage)
        path = writer.write(tmp_path / storage, [
            *images(writer), *truth_records(writer, '/point', writer.point_stamped),
            *truth_records(writer, '/transform', writer.transform),
            ('/info', START_NS, writer.camera_info(33.0, distortion=(0.1, 0.2)))])
        with Bag(path) as bag:
            raw[storage] = list(bag.raw_messages(bag.topics, 0, FOREVER))
    assert sorted(raw['ros1']) == sorted(raw['mcap'])
    assert len(raw['ros1']) == 3 * len(STAMPS_NS) + 1


@pytest.mark.parametrize('storage', ['ros1', 'sqlite3', 'mcap'])
def test_raw_messages_of_some_topics_between_two_times(storage, tmp_path):
    writer = BagWriter(storage)
    records = [(topic, START_NS + index, writer.point_stamped(START_NS + index, POSES[0]))
               for index in range(10) for topic in ('/a', '/b', '/c')]
    with Bag(writer.write(tmp_path / 'bag', records)) as bag:
        assert (bag.start_ns, bag.end_ns) == (START_NS, START_NS + 10)
        chosen = list(bag.raw_messages(['/a', '/c'], START_NS + 3, START_NS + 6))
    assert sorted((topic, bag_time_ns) for topic, bag_time_ns, _ in chosen) == [
        (topic, START_NS + index) for topic in ('/a', '/c') for index in (3, 4, 5)]
    assert [bag_time_ns for _, bag_time_ns, _ in chosen] == sorted(
        bag_time_ns for _, bag_time_ns, _ in chosen)
    point = ROS2.deserialize_cdr(chosen[0][2], 'geometry_msgs/msg/PointStamped')
    assert point.header.stamp.nanosec == (START_NS + 3) % 10 ** 9


@pytest.mark.parametrize('storage', ['ros1', 'mcap'])
def test_layout_is_that_of_ros2(storage, tmp_path):
    writer = BagWriter(storage)
    path = writer.write(tmp_path / 'bag', [
        *images(writer), ('/info', START_NS, writer.camera_info(33.0))])
    with Bag(path) as bag:
        image, info = (bag.layout(f'sensor_msgs/msg/{name}') for name in ('Image', 'CameraInfo'))
        assert bag.layout('acme_msgs/msg/Gadget') is None
    header = '((int32 uint32) string)'
    assert image == f'{header} uint32 uint32 string uint8 uint32 uint8[]'
    assert info == (f'{header} uint32 uint32 string float64[] float64[9] float64[9] float64[12] '
                    'uint32 uint32 (uint32 uint32 uint32 uint32 bool)')


def test_delivery_of_ros1(tmp_path):
    writer = BagWriter('ros1')
    writer.offers = {'/latched': {'latching': 1}}
    point = writer.point_stamped(START_NS, POSES[0])
    path = writer.write(tmp_path / 'bag', [('/latched', 1, point), ('/other', 2, point)])
    with Bag(path) as bag:
        assert bag.delivery('/latched') == Delivery(reliable=True, latched=True, depth=1)
        assert bag.delivery('/other') == Delivery(reliable=True, latched=False, depth=0)


def test_image_topics_are_by_name_and_depth_comes_last(tmp_path):
    writer = BagWriter('mcap')
    names = ('/zed/image', '/camera/depth/image', '/camera/rgb/image')
    records = [record for name in names for record in images(writer, name)]
    with Bag(writer.write(tmp_path / 'bag', records)) as bag:
        assert bag.image_topics() == ['/camera/rgb/image', '/zed/image', '/camera/depth/image']


def test_read_ahead_keeps_order_and_tells_an_error_where_it_happened():
    def items():
        yield from range(100)
        raise ValueError('damaged')

    heard = []
    with ReadAhead(items(), lambda item: 1, 8) as ahead:  # noqa: SIM117
        with pytest.raises(ValueError, match='damaged'):
            heard.extend(ahead)
    assert heard == list(range(100))


@pytest.mark.parametrize('size', [1, 3, 100])
def test_read_ahead_holds_no_more_than_its_limit(size):
    fetched = []

    def items():
        for number in count():
            fetched.append(number)
            yield number

    with ReadAhead(items(), lambda item: size, 10) as ahead:
        assert list(islice(ahead, 5)) == [0, 1, 2, 3, 4]
        time.sleep(0.1)
        held = -(-10 // size)  # what reaches the limit, and one more in the hand
        assert 5 + held <= len(fetched) <= 5 + held + 1
        threads = threading.active_count()
    assert threading.active_count() == threads - 1  # left early, it has stopped reading


def test_pacing_is_never_early_and_does_not_drift():
    pacing = PlaybackClock(rate=10.0)
    began = time.monotonic_ns()
    pacing.begin(START_NS)
    for index in range(100):
        late_ns = pacing.wait_for(START_NS + index * 20_000_000)
        elapsed_ns = time.monotonic_ns() - began
        assert elapsed_ns >= index * 2_000_000 + late_ns
        if index == 50:
            time.sleep(0.09)  # a delay is made up for
    assert elapsed_ns < 99 * 2_000_000 + 90_000_000


def test_pacing_tells_how_late_it_is():
    pacing = PlaybackClock(rate=1.0)
    pacing.begin(0)
    time.sleep(0.03)
    assert 0.02e9 < pacing.wait_for(10_000_000) < 0.5e9


def test_pacing_ticks_by_the_time_of_the_bag():
    ticks = []
    pacing = PlaybackClock(2.0, ticks.append, frequency=200.0)
    pacing.begin(START_NS)
    pacing.wait_for(START_NS + 200_000_000)
    assert ticks[0] - START_NS < 20_000_000
    assert len(ticks) == pytest.approx(20, abs=8)
    assert np.median(np.diff(ticks)) == pytest.approx(10_000_000, rel=0.2)
    assert (np.diff(ticks) > 0).all()


def test_without_ros_one_line_says_how_to_get_it(tmp_path):
    writer = BagWriter('ros1')
    bag = writer.write(tmp_path / 'bag', images(writer))
    code = ("import sys; sys.modules['rclpy'] = None; from kfvo_ros.play import main; "
            'sys.exit(main(sys.argv[1:]))')
    for arguments in ([], ['--ros-args', '-r', 'a:=b']):
        done = subprocess.run([sys.executable, '-c', code, str(bag), *arguments], text=True,
                              capture_output=True, cwd=Path(kfvo_ros.__file__).parents[1],
                              timeout=60, check=False)
        assert done.returncode == 1
        line, = done.stderr.splitlines()
        assert 'rclpy is missing: source /opt/ros/jazzy/setup.bash' in line
        assert "pip install 'kfvo_ros[ros]'" in line
