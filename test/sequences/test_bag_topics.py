# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choice of image and CameraInfo topics of a bag, and names that ROS 2 allows."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from bag_writers import PINHOLE, STAMPS_NS, START_NS, BagBuilder, Records, images, open_bag
from sequence_writers import make_image

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.bag.topics import is_legal_topic, legal_topic


def encoded(writer: BagBuilder, topic: str, encoding: str, count: int = 5) -> Records:
    """Return images of noise in an encoding of 1, 2 or 4 bytes."""
    dtype = {'32FC1': np.float32, 'mono16': np.uint16, '16UC1': np.uint16}.get(encoding, np.uint8)
    return [(topic, stamp, writer.image(stamp, make_image(index).astype(dtype), 'camera',
                                        encoding))
            for index, stamp in enumerate(STAMPS_NS[:count])]


def info(writer: BagBuilder, topic: str, fx: float = 33.0, frame_id: str = '') -> Records:
    message = writer.camera_info(fx)
    message.header.frame_id = frame_id
    return [(topic, START_NS, message)]


def test_choice_of_the_image_topic(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    writer = BagBuilder('mcap')
    topics = ('/zed/image', '/camera/depth/image', '/camera/rgb/image', '/camera/rgb/other')
    sequence = open_bag(writer, tmp_path, *(images(writer, topic) for topic in topics))
    assert sequence.topic == '/camera/rgb/image'
    assert sequence.sources == {'image_topic': '/camera/rgb/image'}
    choice = next(record.message for record in caplog.records if 'others' in record.message)
    assert '/camera/rgb/other, /zed/image, /camera/depth/image (choose by --image-topic)' in choice
    bag = str(tmp_path / 'walk')
    for topic in ('/zed/image', 'zed/image'):
        assert open_sequence(bag, image_topic=topic, camera=PINHOLE).topic == '/zed/image'
    with pytest.raises(KfvoError, match='topic /nope holds no images; these do: /camera/depth'):
        open_sequence(bag, image_topic='/nope')


@pytest.mark.parametrize(('others', 'chosen'), [
    ({'/a/depth': 'mono16'}, '/cam/image'), ({'/Depth_0/data': '16UC1'}, '/cam/image'),
    ({'/a/confidence': 'mono8'}, '/cam/image'), ({'/a/disparity': '32FC1'}, '/cam/image'),
    ({'/a/raw': '32FC1'}, '/cam/image'), ({'/a/cnn_label': '8UC1'}, '/cam/image'),
    ({'/a/infra1': 'mono8'}, '/cam/image'), ({'/a/ir/image': 'mono8'}, '/cam/image'),
    ({'/a/raw': '16UC1'}, '/cam/image'), ({'/depthai/image': 'mono8'}, '/cam/image'),
    ({'/airship/image': 'mono8'}, '/airship/image')])
@pytest.mark.parametrize('storage', ['ros1', 'mcap'])
def test_images_of_cameras_come_before_measurements(storage, others, chosen, tmp_path):
    writer = BagBuilder(storage)
    sequence = open_bag(writer, tmp_path, images(writer, '/cam/image'), *(
        encoded(writer, topic, encoding) for topic, encoding in others.items()))
    assert sequence.topic == chosen


@pytest.mark.parametrize(('topic', 'encoding'), [
    ('/cam/image', '32FC1'), ('/cam/depth', 'mono16'), ('/cam/confidence', 'mono8')])
def test_measurements_are_never_chosen(topic, encoding, tmp_path):
    writer = BagBuilder('mcap')
    with pytest.raises(KfvoError, match=f'depth or other measurements: {topic}; ask .*--image'):
        open_bag(writer, tmp_path, encoded(writer, topic, encoding))
    if encoding != '32FC1':
        assert open_sequence(str(tmp_path / 'walk'), camera=PINHOLE, image_topic=topic).length == 5


def test_topics_with_a_calibration_and_with_many_images_come_first(tmp_path):
    writer = BagBuilder('mcap')
    few = encoded(writer, '/a/preview', 'mono8', count=2)
    every = [images(writer, '/b/image'), images(writer, '/c/image')]
    assert open_bag(writer, tmp_path / '1', few, *every).topic == '/b/image'
    calibrated = open_bag(writer, tmp_path / '2', few, *every, info(writer, '/c/camera_info'))
    assert calibrated.topic == '/c/image'


@pytest.mark.parametrize(('images_on', 'info_on'), [
    ('/cam0/image_raw', '/cam0/camera_info'), ('/image_raw', '/camera_info'),
    ('/drone/front/Scene', '/drone/front/Scene/camera_info'),
    ('/device_0/sensor_1/Color_0/image/data', '/device_0/sensor_1/Color_0/info/camera_info'),
    ('/zed/rgb/color/rect/image', '/zed/rgb/color/rect/image/camera_info'),
    ('/cam0/image_raw', '/the/only/one'), ('/camera', '/camera_info')])
@pytest.mark.parametrize('storage', ['ros1', 'mcap'])
def test_where_camera_info_is_found(storage, images_on, info_on, tmp_path):
    writer = BagBuilder(storage)
    message = writer.camera_info(33.0, projection_fx=33.0)
    camera = open_bag(writer, tmp_path, [(info_on, START_NS, message)], images(writer, images_on),
                      camera=None).camera
    assert camera.fx == 33.0 and not camera.guessed


@pytest.mark.parametrize('infos', [{'/left/camera_info': 'camera'},
                                   {'/a/info': 'camera', '/b/info': 'camera'},
                                   {'/a/info': 'other_frame'}])
def test_the_camera_info_of_other_images_is_named_only(infos, tmp_path, caplog):
    writer = BagBuilder('mcap')
    camera = open_bag(
        writer, tmp_path, images(writer, '/right/image'), images(writer, '/left/image'),
        *(info(writer, topic, frame_id=frame) for topic, frame in infos.items()), camera=None,
        image_topic='/right/image').camera
    assert camera.guessed
    assert f'CameraInfo topics of the bag: {", ".join(infos)}' in caplog.text


@pytest.mark.parametrize('broken', [0.0, -1.0])
def test_the_first_calibrated_camera_info_counts(broken, tmp_path):
    writer = BagBuilder('mcap')
    records = [('/cam0/camera_info', START_NS + index, writer.camera_info(fx))
               for index, fx in enumerate((broken, broken, 33.0, 44.0))]
    assert open_bag(writer, tmp_path, records, images(writer), camera=None).camera.fx == 33.0


@pytest.mark.parametrize(('name', 'expected'), [
    ('/camera/image_raw', '/camera/image_raw'), ('/mocap/1/pose', '/mocap/id_1/pose'),
    ('/1', '/id_1'), ('/a//b', '/a/b'), ('/a__b/c-d', '/a_b/c_d'), ('/~x/\u00fc', '/_x/_'),
    ('/a/', '/a')])
def test_legal_names(name, expected):
    assert legal_topic(name) == expected and is_legal_topic(expected)
    assert is_legal_topic(name) == (name == expected)
