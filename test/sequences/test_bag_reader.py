# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bag reader: raw messages, wire formats, QoS and image topics."""

from __future__ import annotations

import sqlite3

import numpy as np
import pytest
from bag_writers import LATER_NS, POSES, STAMPS_NS, START_NS, BagBuilder, images, truth_records
from rosbags.typesys import Stores, get_typestore

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.reader import Bag, QosOffer

END_NS = 2 ** 62
"""Later than any message."""
ROS2 = get_typestore(Stores.ROS2_JAZZY)


def test_ros1_messages_are_converted_to_ros2(tmp_path):
    """Byte for byte as a ROS 2 writer records them."""
    raw = {}
    for storage in ('ros1', 'mcap'):
        writer = BagBuilder(storage)
        path = writer.write(tmp_path / storage, [
            *images(writer), *truth_records(writer, '/point', writer.point_stamped),
            *truth_records(writer, '/transform', writer.transform),
            ('/info', START_NS, writer.camera_info(33.0, distortion=(0.1, 0.2)))])
        with Bag(path) as bag:
            raw[storage] = list(bag.raw_messages(bag.topics, 0, END_NS))
    assert sorted(raw['ros1']) == sorted(raw['mcap'])
    assert len(raw['ros1']) == 3 * len(STAMPS_NS) + 1


@pytest.mark.parametrize('storage', ['ros1', 'sqlite3', 'mcap'])
def test_raw_messages_of_selected_topics_in_a_time_range(storage, tmp_path):
    writer = BagBuilder(storage)
    records = [(topic, START_NS + index, writer.point_stamped(START_NS + index, POSES[0]))
               for index in range(10) for topic in ('/a', '/b', '/c')]
    with Bag(writer.write(tmp_path / 'bag', records)) as bag:
        assert (bag.start_ns, bag.end_ns) == (START_NS, START_NS + 10)
        selected = list(bag.raw_messages(['/a', '/c'], START_NS + 3, START_NS + 6))
    assert sorted((topic, bag_time_ns) for topic, bag_time_ns, _ in selected) == [
        (topic, START_NS + index) for topic in ('/a', '/c') for index in (3, 4, 5)]
    assert [bag_time_ns for _, bag_time_ns, _ in selected] == sorted(
        bag_time_ns for _, bag_time_ns, _ in selected)
    point = ROS2.deserialize_cdr(selected[0][2], 'geometry_msgs/msg/PointStamped')
    assert point.header.stamp.nanosec == (START_NS + 3) % 10 ** 9


@pytest.mark.parametrize('storage', ['ros1', 'mcap'])
def test_wire_format_is_that_of_ros2(storage, tmp_path):
    writer = BagBuilder(storage)
    path = writer.write(tmp_path / 'bag', [
        *images(writer), ('/info', START_NS, writer.camera_info(33.0))])
    with Bag(path) as bag:
        image, info = (bag.wire_format(f'sensor_msgs/msg/{name}')
                       for name in ('Image', 'CameraInfo'))
        assert bag.wire_format('acme_msgs/msg/Gadget') is None
    header = '((int32 uint32) string)'
    assert image == f'{header} uint32 uint32 string uint8 uint32 uint8[]'
    assert info == (f'{header} uint32 uint32 string float64[] float64[9] float64[9] float64[12] '
                    'uint32 uint32 (uint32 uint32 uint32 uint32 bool)')


def test_qos_offer_of_ros1(tmp_path):
    writer = BagBuilder('ros1')
    writer.offers = {'/latched': {'latching': 1}}
    point = writer.point_stamped(START_NS, POSES[0])
    path = writer.write(tmp_path / 'bag', [('/latched', 1, point), ('/other', 2, point)])
    with Bag(path) as bag:
        assert bag.qos_offer('/latched') == QosOffer(reliable=True, latched=True, depth=1)
        assert bag.qos_offer('/other') == QosOffer(reliable=True, latched=False, depth=0)


@pytest.mark.parametrize('storage', ['ros1', 'mcap'])
def test_a_definition_that_lacks_a_field_is_one_clear_error(storage, tmp_path):
    writer = BagBuilder(storage)
    name = 'sensor_msgs/msg/Image'
    store = get_typestore(Stores.ROS1_NOETIC if storage == 'ros1' else Stores.ROS2_JAZZY)
    fields = store.fielddefs[name]
    writer.store = get_typestore(Stores.EMPTY)
    writer.store.register({**{kind: store.fielddefs[kind] for kind in (
        'std_msgs/msg/Header', 'builtin_interfaces/msg/Time')}, name: (
            fields[0], [field for field in fields[1] if field[0] != 'step'])})
    image = writer.store.types[name](header=writer.header(START_NS), height=1, width=1,
                                     encoding='mono8', is_bigendian=0,
                                     data=np.zeros(1, np.uint8))
    with Bag(writer.write(tmp_path / 'bag', [('/image', START_NS, image)])) as bag, \
            pytest.raises(KfvoError, match='definition of sensor_msgs/msg/Image has no step'):
        bag.first_message('/image')


def test_a_message_that_cannot_be_decoded_is_left_out(tmp_path, caplog):
    writer = BagBuilder('sqlite3')
    path = writer.write(tmp_path / 'bag', truth_records(writer, '/pose', writer.pose_stamped))
    with sqlite3.connect(path / 'bag.db3') as database:
        database.execute("UPDATE messages SET data = X'00010000' WHERE id = 3")
    database.close()
    with Bag(path) as bag:
        assert [bag_time_ns for bag_time_ns, _ in bag.messages('/pose')] == [
            stamp_ns + LATER_NS for stamp_ns in STAMPS_NS if stamp_ns != STAMPS_NS[2]]
    assert 'a message on /pose' in caplog.text and 'left out' in caplog.text


def test_a_broken_definition_spoils_no_other_topic(tmp_path, caplog):
    writer = BagBuilder('sqlite3')
    path = writer.write(tmp_path / 'bag', [
        *truth_records(writer, '/pose', writer.pose_stamped),
        *truth_records(writer, '/point', writer.point_stamped)])
    with sqlite3.connect(path / 'bag.db3') as database:
        database.execute('UPDATE message_definitions SET encoded_message_definition = "float x y" '
                         'WHERE topic_type = "geometry_msgs/msg/PointStamped"')
    database.close()
    with Bag(path) as bag:
        assert bag.topics == {'/pose': 'geometry_msgs/msg/PoseStamped'}
        assert list(bag.passed_over) == ['/point']
        assert len(list(bag.messages('/pose'))) == len(STAMPS_NS)
    assert '/point is passed over' in caplog.text
