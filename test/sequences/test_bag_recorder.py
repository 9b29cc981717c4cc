# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every kind of sequence reads back from its recording; contents of the recorded bag."""

from __future__ import annotations

import struct
import tracemalloc
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from bag_writers import COUNT, POSES, STAMPS_NS, START_NS, BagBuilder, images, truth_records
from mcap.reader import make_reader
from recordings import (
    DATASETS,
    assert_same_sequence,
    convert_and_open,
    messages_of,
    topics_of,
    write_sequence,
)
from rosbags.highlevel import AnyReader
from sequence_writers import HEIGHT, WIDTH, make_image, write_euroc

from kfvo_ros.camera import Camera
from kfvo_ros.sequences import KINDS, open_sequence
from kfvo_ros.sequences.bag.camera import camera_from_info
from kfvo_ros.sequences.bag.messages import camera_info_message
from kfvo_ros.sequences.bag.recorder import Recorder
from kfvo_ros.sequences.bag.writer import BagWriter
from kfvo_ros.sequences.calibration import read_camera_info, write_camera_info

# Round trips


@pytest.mark.parametrize('colour', [False, True])
@pytest.mark.parametrize('kind', ['euroc', 'tum', 'kitti', 'tartanair', 'ros1', 'sqlite3', 'mcap',
                                  'folder'])
def test_sequences_read_back(kind, colour, tmp_path):
    source = write_sequence(kind, tmp_path / 'in', colour)
    copy = convert_and_open(source, tmp_path / 'out' / kind, *['--compressed'] * colour)
    assert_same_sequence(open_sequence(source), copy, COUNT)
    wanted = '/left/image_raw' if kind in ('ros1', 'sqlite3', 'mcap') else '/camera/image_raw'
    assert copy.topic == wanted + '/compressed' * colour


@pytest.mark.parametrize('kind', ['video', 'synthetic'])
def test_sequences_without_image_files_read_back(kind, tmp_path):
    source = write_sequence(kind, tmp_path)
    copy = convert_and_open(source, tmp_path / 'out', '--stop', 3)
    assert_same_sequence(open_sequence(source), copy, 3)


def test_every_kind_is_tested():
    assert set(KINDS) == {*DATASETS, 'bag', 'folder', 'video'}


@pytest.mark.parametrize('colour', [False, True])
def test_jpeg_loses_little(colour, tmp_path):
    smooth = [cv2.GaussianBlur(make_image(index, colour), (0, 0), 4.0) for index in range(COUNT)]
    source = str(write_euroc(tmp_path, smooth, POSES)[0])
    copy = convert_and_open(source, tmp_path / 'out', '--compressed', 'jpeg')
    assert_same_sequence(open_sequence(source), copy, COUNT, tolerance=2.0)
    _, message = next(iter(messages_of(tmp_path / 'out', '/camera/image_raw/compressed')))
    assert bytes(message.data[:2]) == b'\xff\xd8'
    assert message.format == ('rgb8' if colour else 'mono8') + '; jpeg compressed ' + \
        'bgr8' * colour


def test_a_recording_of_a_recording_is_the_same(tmp_path):
    source = write_sequence('tum', tmp_path)
    convert_and_open(source, tmp_path / 'one', '--compressed')
    copy = convert_and_open(str(tmp_path / 'one'), tmp_path / 'two')
    assert_same_sequence(open_sequence(source), copy, COUNT)


@pytest.mark.parametrize('storage', ['ros1', 'mcap'])
def test_point_ground_truth_keeps_its_topic(storage, tmp_path):
    writer = BagBuilder(storage)
    path = writer.write(tmp_path / 'walk', images(writer) + truth_records(
        writer, '/leica/position', writer.point_stamped))
    copy = convert_and_open(str(path), tmp_path / 'out')
    assert_same_sequence(open_sequence(str(path)), copy, COUNT)
    assert copy.ground_truth().frame == '/leica/position'


def test_ground_truth_of_a_body_without_a_transform_to_the_camera(tmp_path):
    writer = BagBuilder('mcap')
    path = writer.write(tmp_path / 'walk', images(writer) + truth_records(
        writer, '/vicon', writer.transform))
    copy = convert_and_open(str(path), tmp_path / 'out')
    assert_same_sequence(open_sequence(str(path)), copy, COUNT)
    assert '/tf_static' not in topics_of(tmp_path / 'out')
    located = convert_and_open(str(path), tmp_path / 'located', '--ground-truth-to-camera',
                               '1 2 3 0 0 0 1')
    assert located.ground_truth().frame == 'camera'
    assert [fixed.parent for fixed in located.extrinsics()] == ['body']


# Contents of the bag


def test_messages(tmp_path):
    convert_and_open(write_sequence('euroc', tmp_path), tmp_path / 'out', '--topic',
                     'cam0/image_raw')
    stamps = {}
    for topic in ('/cam0/image_raw', '/cam0/camera_info', '/ground_truth/odometry'):
        messages = list(messages_of(tmp_path / 'out', topic))
        stamps[topic] = [m.header.stamp.sec * 10 ** 9 + m.header.stamp.nanosec
                         for _, m in messages]
        assert stamps[topic] == [bag_time_ns for bag_time_ns, _ in messages]
    assert len({tuple(values) for values in stamps.values()}) == 1
    _, image = next(iter(messages_of(tmp_path / 'out', '/cam0/image_raw')))
    _, info = next(iter(messages_of(tmp_path / 'out', '/cam0/camera_info')))
    _, odometry = next(iter(messages_of(tmp_path / 'out', '/ground_truth/odometry')))
    assert image.header.frame_id == info.header.frame_id == odometry.child_frame_id \
        == 'camera_optical_frame'
    assert (image.encoding, image.step) == ('mono8', WIDTH)
    assert (info.distortion_model, list(info.d)) == ('plumb_bob', [-0.28, 0.07, 2e-4, 1.8e-5, 0])
    assert list(info.k) == [30.0, 0, 16.5, 0, 31.0, 12.5, 0, 0, 1]
    assert list(info.p) == [30.0, 0, 16.5, 0, 0, 31.0, 12.5, 0, 0, 0, 1, 0]
    assert list(info.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert odometry.header.frame_id == 'world' and odometry.twist.covariance[0] > 1e3
    with AnyReader([tmp_path / 'out']) as reader:
        order = [connection.topic for connection, _, _ in reader.messages()]
    assert order[0] == '/tf_static' and Counter(order)['/tf_static'] == 1
    assert order[1:4] == ['/ground_truth/odometry', '/cam0/camera_info', '/cam0/image_raw']


@pytest.mark.parametrize('camera', [
    Camera(40, 30, 33.0, 34.0, 19.5, 14.5),
    Camera(40, 30, 33.0, 34.0, 19.5, 14.5, 'radtan', (0.1, 0.2, 0.3, 0.4)),
    Camera(40, 30, 33.0, 34.0, 19.5, 14.5, 'rational_polynomial', (0.1,) * 8),
    Camera(40, 30, 33.0, 34.0, 19.5, 14.5, 'equidistant', (0.0,) * 4)])
def test_every_distortion_model_reads_back(camera, tmp_path):
    """CameraInfo holds the camera; the calibration file also holds the readout time."""
    info = camera_info_message(START_NS, 'camera', camera)
    assert camera_from_info(info, rectified=False, width=0, height=0) == camera
    assert len(info.d) in (4, 5, 8) and info.distortion_model != 'none'
    rolling = replace(camera, readout_s=1 / 300)
    write_camera_info(tmp_path / 'camera_info.yaml', rolling)
    assert read_camera_info(tmp_path / 'camera_info.yaml') == rolling


def test_quality_of_service(tmp_path):
    convert_and_open(write_sequence('euroc', tmp_path), tmp_path / 'out')
    for name, topic in topics_of(tmp_path / 'out').items():
        offered, = topic['offered_qos_profiles']
        latched = name == '/tf_static'
        assert (offered['reliability'], offered['history']) == ('reliable', 'keep_last')
        assert offered['durability'] == ('transient_local' if latched else 'volatile')
        assert topic['message_count'] == (1 if latched else COUNT)


@pytest.mark.parametrize('version', [8, 9])
def test_metadata_version(version, tmp_path):
    convert_and_open(write_sequence('euroc', tmp_path), tmp_path / 'out',
                     '--metadata-version', version)
    metadata = yaml.safe_load((tmp_path / 'out' / 'metadata.yaml').read_text())
    information = metadata['rosbag2_bagfile_information']
    assert (information['version'], information['storage_identifier']) == (version, 'mcap')
    profiles = topics_of(tmp_path / 'out')['/tf_static']['offered_qos_profiles']
    assert isinstance(profiles, str if version == 8 else list)


@pytest.mark.parametrize('zstd', [False, True])
def test_chunks(zstd, tmp_path):
    convert_and_open(write_sequence('euroc', tmp_path), tmp_path / 'out', *['--zstd'] * zstd)
    with (tmp_path / 'out' / 'out.mcap').open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        assert {chunk.compression for chunk in reader.get_summary().chunk_indexes} == {
            'zstd' if zstd else ''}
        assert sum(1 for _ in reader.iter_messages()) == 3 * COUNT + 1
        for index in reader.get_summary().chunk_indexes:
            file.seek(index.chunk_start_offset + 9 + 24)
            assert struct.unpack('<I', file.read(4))[0] != 0  # the CRC


@pytest.mark.parametrize('codec', [[], ['--compressed']])
def test_the_readout_time_is_kept_in_a_metadata_record(codec, tmp_path):
    """Older recordings have a calibration file for it, which takes precedence."""
    copy = convert_and_open(write_sequence('tum', tmp_path), tmp_path / 'out', *codec)
    assert copy.camera.readout_s == 0.03
    assert sorted(path.name for path in (tmp_path / 'out').iterdir()) == ['metadata.yaml',
                                                                          'out.mcap']
    write_camera_info(tmp_path / 'out' / 'camera_info.yaml', replace(copy.camera, readout_s=0.02))
    assert open_sequence(str(tmp_path / 'out')).camera.readout_s == 0.02


def test_names_that_ros2_refuses_are_changed(tmp_path, caplog):
    writer = BagBuilder('ros1')
    path = writer.write(tmp_path / 'walk', images(writer, '/cam/1/image_raw') + truth_records(
        writer, '/mocap/1/pose', writer.pose_stamped))
    copy = convert_and_open(str(path), tmp_path / 'out')
    assert set(topics_of(tmp_path / 'out')) == {'/cam/id_1/image_raw', '/mocap/id_1/pose'}
    assert copy.ground_truth().frame == '/mocap/id_1/pose'
    assert 'does not allow the topic /mocap/1/pose' in caplog.text


def test_ground_truth_problems_do_not_stop_a_conversion(tmp_path, caplog):
    source = write_sequence('tartanair', tmp_path)
    Path(source, 'pose_left.txt').write_text('no poses')
    copy = convert_and_open(source, tmp_path / 'out')
    assert len(list(copy)) == COUNT and copy.ground_truth() is None
    assert 'pose_left.txt, line 1' in caplog.text


def test_ground_truth_outside_ros_time_is_left_out(tmp_path, caplog):
    source = write_sequence('tum', tmp_path)
    file = Path(source, 'groundtruth.txt')
    file.write_text(file.read_text() + '5000000000.0 0 0 0 0 0 0 1\n-5 0 0 0 0 0 0 1\n')
    copy = convert_and_open(source, tmp_path / 'out')
    assert len(copy.ground_truth().trajectory) == COUNT
    assert f'left out 2 of {COUNT + 2} poses of the ground truth' in caplog.text


def test_a_guessed_camera_is_not_recorded(tmp_path, capsys):
    convert_and_open(write_sequence('video', tmp_path), tmp_path / 'out')
    assert list(topics_of(tmp_path / 'out')) == ['/camera/image_raw']
    assert 'no CameraInfo' in capsys.readouterr().out
    camera = Camera(WIDTH, HEIGHT, 44.0, 44.0, 16.0, 12.0)
    write_camera_info(tmp_path / 'phone.yaml', camera)
    copy = convert_and_open(str(tmp_path / 'walk.avi'), tmp_path / 'calibrated', '--camera',
                     tmp_path / 'phone.yaml')
    assert copy.camera == camera


def test_ground_truth_is_in_time_order_and_ends_with_the_images(tmp_path):
    writer = BagBuilder('mcap')
    step = (STAMPS_NS[1] - STAMPS_NS[0]) // 5
    records = [('/vicon', START_NS + n * step, writer.transform(START_NS + n * step, POSES[0]))
               for n in range(-10, 40)]
    source = str(writer.write(tmp_path / 'walk', images(writer, '/image_raw') + records[::-1]))
    for bag, arguments, count in (('all', (), 50), ('cut', ('--stop', 2), 17)):
        convert_and_open(source, tmp_path / bag, *arguments)
        with AnyReader([tmp_path / bag]) as reader:
            times = [bag_time_ns for _, bag_time_ns, _ in reader.messages()]
        with (tmp_path / bag / f'{bag}.mcap').open('rb') as file:
            written = [message.log_time for _, _, message in
                       make_reader(file).iter_messages(log_time_order=False)]
        assert times == written == sorted(written)
        assert topics_of(tmp_path / bag)['/ground_truth/odometry']['message_count'] == count


def test_memory_does_not_grow_with_length(tmp_path):
    writer = BagWriter(tmp_path / 'out')
    sequence = open_sequence(write_sequence('folder', tmp_path))
    recorder = Recorder(sequence, writer)
    frame, image = next(iter(sequence)), np.zeros((480, 640), np.uint8)
    tracemalloc.start()
    for index in range(60):
        recorder.write(replace(frame, image=image, stamp_ns=START_NS + index))
    recorder.finish(complete=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert recorder.frame_count == 60 and peak < 20 * image.nbytes
