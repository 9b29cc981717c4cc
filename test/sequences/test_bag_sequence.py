# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images and cameras of ROS 1 and ROS 2 bags."""

from __future__ import annotations

import shutil
import sqlite3
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from bag_writers import (
    COUNT,
    LATER_NS,
    PINHOLE,
    POSES,
    STAMPS_NS,
    START_NS,
    STORAGES,
    BagBuilder,
    images,
    open_bag,
)
from rosbags import rosbag1, rosbag2
from sequence_writers import HEIGHT, WIDTH, make_image, write_camera_info

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence

every_storage = pytest.mark.parametrize('storage', STORAGES)


@pytest.mark.parametrize('colour', [False, True])
@every_storage
def test_raw_images_read_back(storage, colour, tmp_path):
    sequence = open_bag(writer := BagBuilder(storage), tmp_path, images(writer, colour=colour))
    assert (sequence.name, sequence.length) == ('walk', COUNT)
    for _ in range(2):
        frames = list(sequence)
        assert [frame.stamp_ns for frame in frames] == STAMPS_NS
        assert all(type(frame.stamp_ns) is int for frame in frames)
        for index, frame in enumerate(frames):
            np.testing.assert_array_equal(frame.image, make_image(index, colour))
            assert frame.camera == PINHOLE and frame.image.flags.writeable
    assert sequence.ground_truth() is None


@every_storage
def test_compressed_images_read_back(storage, tmp_path):
    writer = BagBuilder(storage)
    records = [('/cam0/image_raw/compressed', stamp, writer.compressed(
        stamp, make_image(index, colour=True), 'rgb8; png compressed bgr8'))
        for index, stamp in enumerate(STAMPS_NS)]
    info = [('/cam0/camera_info', START_NS, writer.camera_info(33.0))]
    frames = list(open_bag(writer, tmp_path, info, records, camera=None))
    assert [frame.stamp_ns for frame in frames] == STAMPS_NS
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, make_image(index, colour=True))
        assert frame.camera.fx == 33.0


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_a_single_file_without_its_metadata(storage, tmp_path):
    writer = BagBuilder(storage)
    folder = writer.write(tmp_path / 'walk', images(writer))
    file, = folder.glob('walk.*')
    shutil.move(file, tmp_path / file.name)
    sequence = open_sequence(str(tmp_path / file.name), camera=PINHOLE)
    assert [frame.stamp_ns for frame in sequence] == STAMPS_NS


@pytest.mark.parametrize('storage', ['ros1', 'mcap', 'sqlite3'])
def test_compressed_storage(storage, tmp_path):
    writer = BagBuilder(storage)
    path = tmp_path / ('walk.bag' if writer.is_ros1 else 'walk')
    if writer.is_ros1:
        recorder = rosbag1.Writer(path)
        recorder.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
        serialize = writer.store.serialize_ros1
    else:
        recorder = rosbag2.Writer(path, version=8,
                                  storage_plugin=rosbag2.StoragePlugin[storage.upper()])
        mode = 'STORAGE' if storage == 'mcap' else 'FILE'
        recorder.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
        serialize = writer.store.serialize_cdr
    with recorder:
        kind = 'sensor_msgs/msg/Image'
        connection = recorder.add_connection('/image', kind, typestore=writer.store)
        for _, bag_time_ns, message in images(writer):
            recorder.write(connection, bag_time_ns, serialize(message, kind))
    frames = list(open_sequence(str(path), camera=PINHOLE))
    assert [frame.stamp_ns for frame in frames] == STAMPS_NS
    np.testing.assert_array_equal(frames[-1].image, make_image(COUNT - 1))


def test_a_bag_without_message_definitions(tmp_path):
    """ROS 2 before Iron recorded sqlite3 with type names only."""
    writer = BagBuilder('sqlite3')
    path = writer.write(tmp_path / 'walk', images(writer))
    with sqlite3.connect(path / 'walk.db3') as database:
        database.execute('DROP TABLE message_definitions')
        database.execute('UPDATE schema SET schema_version = 3')
    database.close()
    frames = list(open_sequence(str(path), camera=PINHOLE))
    assert [frame.stamp_ns for frame in frames] == STAMPS_NS


@every_storage
def test_bag_time_replaces_stamps_of_zero(storage, tmp_path, caplog):
    writer = BagBuilder(storage)
    records = [('/image', stamp, writer.image(0, make_image(index)))
               for index, stamp in enumerate(STAMPS_NS)]
    assert [frame.stamp_ns for frame in open_bag(writer, tmp_path, records)] == STAMPS_NS
    warning, = caplog.records
    assert 'the stamps of /image are zero; bag times are used' in warning.message


@every_storage
def test_stamps_that_do_not_increase_are_dropped_with_one_warning(storage, tmp_path, caplog):
    writer = BagBuilder(storage)
    order = [0, 1, 1, 0, 2, 1, 3]
    records = [('/image', START_NS + position, writer.image(STAMPS_NS[index], make_image(index)))
               for position, index in enumerate(order)]
    frames = list(open_bag(writer, tmp_path, records))
    assert [frame.stamp_ns for frame in frames] == STAMPS_NS[:4]
    warning, = caplog.records
    assert 'left out 3 images on /image: 2 late, 1 odd stamp' in warning.message


def test_a_bag_without_images(tmp_path):
    writer = BagBuilder('mcap')
    records = [('/odometry', START_NS, writer.odometry(START_NS, POSES[0]))]
    with pytest.raises(KfvoError, match='sensor_msgs/msg/Image.* its topics are: /odometry'):
        open_bag(writer, tmp_path, records)


@every_storage
def test_topics_without_messages_are_ignored(storage, tmp_path):
    writer = BagBuilder(storage)
    writer.empty_topics = {'/a/image': 'sensor_msgs/msg/Image',
                           '/a/odometry': 'nav_msgs/msg/Odometry'}
    sequence = open_bag(writer, tmp_path, images(writer))
    assert sequence.topic == '/cam0/image_raw' and sequence.ground_truth() is None


@pytest.mark.parametrize(('encoding', 'message'), [
    ('mono12', r'/cam0/image_raw at 1403715273\.262142977 s: unknown image encoding'),
    ('rgb8', 'expected a 32x24 rgb8 image')])
def test_images_that_cannot_be_decoded(encoding, message, tmp_path):
    writer = BagBuilder('mcap')
    image = writer.image(START_NS, make_image(0), encoding=encoding)
    with pytest.raises(KfvoError, match=message):
        open_bag(writer, tmp_path, [('/cam0/image_raw', START_NS, image)])


@pytest.mark.parametrize('bad', [0, 2, 4])
def test_an_empty_image_is_left_out(bad, tmp_path, caplog):
    writer = BagBuilder('mcap')
    records = images(writer)
    empty = writer.image(0, np.zeros((1, 1), np.uint8), encoding='')
    empty.height = empty.width = 0
    empty.data = np.zeros(0, np.uint8)
    records[bad] = (*records[bad][:2], empty)
    sequence = open_bag(writer, tmp_path, records)
    assert [frame.stamp_ns for frame in sequence] == [
        stamp for index, stamp in enumerate(STAMPS_NS) if index != bad]
    assert sum(sequence.left_out.values()) == 1 and 'left out 1 images' in caplog.text


def test_an_undecodable_image_with_a_good_stamp_is_left_out(tmp_path, caplog):
    writer = BagBuilder('ros1')
    records = images(writer)
    records[2] = (*records[2][:2], writer.image(STAMPS_NS[2], make_image(2), encoding='mono12'))
    sequence = open_bag(writer, tmp_path, records)
    assert len(list(sequence)) == COUNT - 1 and sequence.left_out == {'unreadable': 1}
    assert "unknown image encoding 'mono12'" in caplog.text


@pytest.mark.parametrize('storage', ['ros1', 'mcap'])
def test_one_stamp_ahead_is_left_out(storage, tmp_path, caplog):
    writer = BagBuilder(storage)
    records = images(writer)
    records[1] = (*records[1][:2], writer.image(STAMPS_NS[1] + 60 * 10 ** 9, make_image(1)))
    sequence = open_bag(writer, tmp_path, records)
    frames = list(sequence)
    assert [frame.stamp_ns for frame in frames] == [STAMPS_NS[0], *STAMPS_NS[2:]]
    np.testing.assert_array_equal(frames[1].image, make_image(2))
    assert sequence.left_out == {'odd_stamp': 1}
    assert 'left out 1 images on /cam0/image_raw: 1 odd stamp' in caplog.text


@pytest.mark.parametrize(('others', 'expected'), [(1, COUNT), (2, COUNT), (3, None)])
def test_images_of_another_size(others, expected, tmp_path):
    """One or two are left out, three in a row are another camera."""
    writer = BagBuilder('ros1')
    other = [('/cam0/image_raw', STAMPS_NS[-1] + LATER_NS + index,
              writer.image(STAMPS_NS[-1] + index, np.zeros((8, 8), np.uint8)))
             for index in range(1, others + 1)]
    sequence = open_bag(writer, tmp_path, images(writer), other)
    if expected is None:
        with pytest.raises(KfvoError, match='the image is 8x8.*32x24'):
            list(sequence)
    else:
        assert len(list(sequence)) == expected and sequence.left_out == {'other_size': others}


# Cameras.


@every_storage
def test_camera_info(storage, tmp_path, caplog):
    """Raw images use K and D, rectified ones P; an explicit camera and a file override both."""
    writer = BagBuilder(storage)
    info = writer.camera_info(33.0, projection_fx=44.0, distortion=(-0.2, 0.1, 0.0, 0.0, 0.01))
    topics = ('/cam0/image_raw', '/cam0/image_rect_color', '/lost/image_raw')
    records = [images(writer, topic) for topic in topics]
    path = str(writer.write(tmp_path / 'walk', sum(
        records, [('/cam0/camera_info', START_NS, info)])))
    raw, rectified = (open_sequence(path, image_topic=topic).camera for topic in topics[:2])
    assert raw == Camera(WIDTH, HEIGHT, 33.0, 33.0, 16.0, 12.0, 'plumb_bob',
                         (-0.2, 0.1, 0.0, 0.0, 0.01))
    assert rectified == Camera(WIDTH, HEIGHT, 44.0, 44.0, 15.0, 11.0)
    assert not caplog.records
    assert open_sequence(path, image_topic=topics[2]).camera.guessed
    assert 'guessing' in caplog.text
    write_camera_info(Path(path) if Path(path).is_dir() else tmp_path, 55.0)
    assert open_sequence(path).camera.fx == 55.0
    assert open_sequence(path, camera=PINHOLE).camera == PINHOLE


def test_an_uncalibrated_camera_info_is_ignored(tmp_path):
    writer = BagBuilder('mcap')
    info = [('/cam0/camera_info', START_NS, writer.camera_info(0.0))]
    assert open_bag(writer, tmp_path, info, images(writer), camera=None).camera.guessed


@pytest.mark.parametrize(('fields', 'expected'), [
    ({'width': 2 * WIDTH, 'height': 2 * HEIGHT, 'binning': 2}, (16.5, 16.5, 7.75, 5.75)),
    ({'width': 40, 'height': 40, 'roi': (5, 3, WIDTH, HEIGHT)}, (33.0, 33.0, 11.0, 9.0)),
    ({'width': 99, 'height': 99, 'roi': (4, 2, 2 * WIDTH, 2 * HEIGHT), 'binning': 2},
     (16.5, 16.5, 5.75, 4.75)),
    ({'binning': 2}, (33.0, 33.0, 16.0, 12.0)),  # set, but not applied to this image
    ({'roi': (0, 0, 16, 12)}, (33.0, 33.0, 16.0, 12.0))])
def test_binning_and_region_of_interest(fields, expected, tmp_path):
    writer = BagBuilder('mcap')
    info = [('/cam0/camera_info', START_NS, writer.camera_info(33.0, **fields))]
    camera = open_bag(writer, tmp_path, info, images(writer), camera=None).camera
    assert camera == Camera(WIDTH, HEIGHT, *expected)


def test_a_camera_info_of_another_size(tmp_path):
    writer = BagBuilder('mcap')
    info = [('/cam0/camera_info', START_NS, writer.camera_info(33.0, width=48))]
    with pytest.raises(KfvoError, match='walk: the calibration is for 48x24 images, 32x24 came'):
        open_bag(writer, tmp_path, info, images(writer), camera=None)


def test_memory_does_not_grow_with_length(tmp_path):
    """The reader keeps the index, not the images."""
    image = np.zeros((480, 640), np.uint8)
    writer = BagBuilder('sqlite3')
    records = (('/image', START_NS + n, writer.image(START_NS + n, image)) for n in range(60))
    sequence = open_bag(writer, tmp_path, records, camera=Camera(640, 480, 500, 500, 320, 240))
    tracemalloc.start()
    count = sum(1 for _ in sequence)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 60 and peak < 8 * image.nbytes
