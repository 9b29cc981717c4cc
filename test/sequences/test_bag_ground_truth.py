# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth in bags: message types, choice of the topic, and transform to the camera."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from bag_writers import (
    COUNT,
    PINHOLE,
    POSES,
    STAMPS_NS,
    START_NS,
    STORAGES,
    BagBuilder,
    Records,
    images,
    open_bag,
    truth_records,
)
from sequence_writers import make_poses

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.base import GroundTruth

T_BODY_CAMERA, T_BODY_MOUNT, T_MOUNT_CAMERA = (make_poses(1, seed)[0] for seed in (7, 8, 9))

every_storage = pytest.mark.parametrize('storage', STORAGES)


def assert_poses(truth: GroundTruth, frame: str, poses: np.ndarray) -> None:
    assert truth.frame == frame and truth.trajectory.has_rotation
    assert truth.trajectory.stamps_ns.tolist() == STAMPS_NS
    np.testing.assert_allclose(truth.trajectory.poses, poses, atol=1e-12)


@pytest.mark.parametrize(('kind', 'frame'), [
    ('odometry', 'body'), ('pose_stamped', '/truth'), ('pose_with_covariance_stamped', '/truth'),
    ('transform', 'body')])
@every_storage
def test_pose_topics(storage, kind, frame, tmp_path):
    """A pose belongs to the frame that its message names, unless the camera is located on it."""
    writer = BagBuilder(storage)
    sequence = open_bag(writer, tmp_path, images(writer),
                        truth_records(writer, '/truth', getattr(writer, kind)))
    assert_poses(sequence.ground_truth(), frame, POSES)
    located = open_sequence(str(sequence._path), camera=PINHOLE,
                            ground_truth_to_camera=T_BODY_CAMERA)
    assert_poses(located.ground_truth(), 'camera', POSES @ T_BODY_CAMERA)


@every_storage
def test_points_have_no_rotation_and_stay_at_the_prism(storage, tmp_path):
    writer = BagBuilder(storage)
    sequence = open_bag(writer, tmp_path, images(writer),
                        truth_records(writer, '/leica/position', writer.point_stamped),
                        ground_truth_to_camera=T_BODY_CAMERA)
    truth = sequence.ground_truth()
    assert truth.frame == '/leica/position' and not truth.trajectory.has_rotation
    assert truth.trajectory.stamps_ns.tolist() == STAMPS_NS
    np.testing.assert_array_equal(truth.trajectory.positions, POSES[:, :3, 3])


def static_chain(writer: BagBuilder) -> Records:
    """Return body -> mount -> camera on /tf_static, and an unconnected transform."""
    still = [writer.transform(START_NS, T_BODY_MOUNT, 'mount', 'body'),
             writer.transform(START_NS, T_MOUNT_CAMERA, 'camera', 'mount'),
             writer.transform(START_NS, np.eye(4), 'tool', 'arm')]
    return [('/tf_static', START_NS, writer.transforms(*still))]


@pytest.mark.parametrize('kind', ['odometry', 'transform'])
@every_storage
def test_static_transforms_lead_to_the_camera(storage, kind, tmp_path):
    writer = BagBuilder(storage)
    truth = truth_records(writer, '/truth', getattr(writer, kind))
    sequence = open_bag(writer, tmp_path, images(writer), truth, static_chain(writer))
    assert_poses(sequence.ground_truth(), 'camera', POSES @ T_BODY_MOUNT @ T_MOUNT_CAMERA)
    explicit = open_sequence(str(sequence._path), camera=PINHOLE,
                             ground_truth_to_camera=T_BODY_CAMERA)
    assert_poses(explicit.ground_truth(), 'camera', POSES @ T_BODY_CAMERA)


def test_the_camera_may_be_the_parent_of_the_measured_frame(tmp_path):
    writer = BagBuilder('mcap')
    marker = writer.transform(START_NS, geometry.invert(T_BODY_CAMERA), 'body', 'camera')
    sequence = open_bag(writer, tmp_path, images(writer),
                        truth_records(writer, '/truth', writer.odometry),
                        [('/tf_static', START_NS, writer.transforms(marker))])
    assert_poses(sequence.ground_truth(), 'camera', POSES @ T_BODY_CAMERA)


def test_disconnected_transforms_leave_the_poses_at_the_body(tmp_path):
    writer = BagBuilder('mcap')
    loop = [writer.transform(START_NS, np.eye(4), *pair)
            for pair in (('body', 'mount'), ('mount', 'body'), ('camera', 'tripod'))]
    loop.append(writer.transform(START_NS, np.eye(4), 'camera', 'body'))
    loop[-1].transform.rotation.w = 0.0  # no rotation: the transform is ignored
    sequence = open_bag(writer, tmp_path, images(writer),
                        truth_records(writer, '/truth', writer.odometry),
                        [('/tf_static', START_NS, writer.transforms(*loop))])
    assert_poses(sequence.ground_truth(), 'body', POSES)


def test_a_moving_camera_mount_is_not_a_fixed_transform(tmp_path):
    writer = BagBuilder('mcap')
    turning = [('/tf', stamp, writer.transforms(writer.transform(stamp, pose, 'camera', 'body')))
               for stamp, pose in zip(STAMPS_NS, make_poses(COUNT, 5))]
    sequence = open_bag(writer, tmp_path, images(writer), turning,
                        truth_records(writer, '/truth', writer.odometry))
    assert_poses(sequence.ground_truth(), 'body', POSES)


def test_ground_truth_of_the_camera_needs_no_transform(tmp_path):
    writer = BagBuilder('mcap')
    truth = [(topic, stamp, writer.odometry(message.header.stamp.sec * 10 ** 9 +
                                            message.header.stamp.nanosec, pose, 'camera'))
             for (topic, stamp, message), pose in zip(
                 truth_records(writer, '/truth', writer.odometry), POSES)]
    assert_poses(open_bag(writer, tmp_path, images(writer), truth).ground_truth(), 'camera', POSES)


@pytest.mark.parametrize(('storage', 'kind'), [
    ('ros1', 'tf/tfMessage'), ('ros1', 'tf2_msgs/TFMessage'), ('sqlite3', 'tf2_msgs/TFMessage'),
    ('mcap', 'tf2_msgs/TFMessage')])
def test_transforms_of_the_tum_bags(storage, kind, tmp_path):
    """/tf has the moving world -> kinect and, repeatedly, the fixed transforms below it."""
    writer = BagBuilder(storage)
    slash = '/' if writer.is_ros1 else ''
    records = []
    for stamp, pose in zip(STAMPS_NS, POSES):
        fixed = [writer.transform(stamp + 7, T_BODY_MOUNT, f'{slash}mount', f'{slash}kinect'),
                 writer.transform(stamp + 7, T_MOUNT_CAMERA, f'{slash}camera', f'{slash}mount')]
        moving = [writer.transform(stamp, pose, f'{slash}kinect', f'{slash}world'),
                  writer.transform(stamp + 9, pose @ pose, f'{slash}hand', f'{slash}arm')]
        records += [('/tf', stamp + 7, writer.transforms(*fixed, kind=kind)),
                    ('/tf', stamp + 9, writer.transforms(*moving, kind=kind))]
    sequence = open_bag(writer, tmp_path, images(writer, frame_id=f'{slash}camera'), records)
    assert_poses(sequence.ground_truth(), 'camera', POSES @ T_BODY_MOUNT @ T_MOUNT_CAMERA)


def test_a_transform_not_connected_to_the_camera_names_its_frame(tmp_path):
    writer = BagBuilder('mcap')
    records = truth_records(writer, '/tf', lambda stamp, pose: writer.transforms(
        writer.transform(stamp, pose, 'kinect')))
    sequence = open_bag(writer, tmp_path, images(writer), records)
    assert_poses(sequence.ground_truth(), 'kinect', POSES)


def test_static_transforms_are_no_ground_truth(tmp_path):
    writer = BagBuilder('mcap')
    records = truth_records(writer, '/tf', lambda stamp, pose: writer.transforms(
        writer.transform(stamp, T_BODY_MOUNT)))
    assert open_bag(writer, tmp_path, images(writer), records).ground_truth() is None
    requested = open_sequence(str(tmp_path / 'walk'), camera=PINHOLE, ground_truth_topic='/tf')
    with pytest.raises(KfvoError, match='expected a moving transform on /tf, found none'):
        requested.ground_truth()


def test_choice_of_the_ground_truth_topic(tmp_path, caplog):
    """The first by type, then by name; topics named odometry come last; a requested one wins."""
    caplog.set_level(logging.INFO)
    writer = BagBuilder('mcap')
    others = {'/a/point': writer.point_stamped, '/b/transform': writer.transform,
              '/d/state': writer.odometry, '/c/state': writer.odometry,
              '/e/pose': writer.pose_stamped, '/a/odometry': writer.odometry}
    sequence = open_bag(writer, tmp_path, images(writer), static_chain(writer), *(
        truth_records(writer, topic, make, make_poses(COUNT, seed))
        for seed, (topic, make) in enumerate(others.items())))
    T_world_camera = make_poses(COUNT, 3) @ T_BODY_MOUNT @ T_MOUNT_CAMERA
    assert_poses(sequence.ground_truth(), 'camera', T_world_camera)
    assert sequence.sources == {'image_topic': '/cam0/image_raw', 'ground_truth_topic': '/c/state'}
    choice = next(record for record in caplog.records if 'candidates' in record.message)
    assert '/c/state is taken' in choice.message and choice.levelno == logging.INFO
    assert choice.message.endswith(
        'other candidates: /d/state, /e/pose, /b/transform, /a/point, /a/odometry')
    bag = str(tmp_path / 'walk')
    requested = open_sequence(bag, camera=PINHOLE, ground_truth_topic='e/pose')
    assert_poses(requested.ground_truth(), '/e/pose', make_poses(COUNT, 4))
    assert requested.sources['ground_truth_topic'] == '/e/pose'
    with pytest.raises(KfvoError, match='/cam0/image_raw holds no poses.*these do: /a/odometry'):
        open_sequence(bag, camera=PINHOLE, ground_truth_topic='/cam0/image_raw')


@pytest.mark.parametrize(('topics', 'chosen'), [
    ({'/odom': 'odometry', '/vrpn/robot/pose': 'pose_stamped'}, '/vrpn/robot/pose'),
    ({'/odom': 'odometry', '/leica/position': 'point_stamped'}, '/leica/position'),
    ({'/wheel/state': 'odometry', '/robot/pose': 'pose_stamped'}, '/robot/pose'),
    ({'/pose': 'pose_stamped', '/ground_truth/odometry': 'odometry'}, '/ground_truth/odometry'),
    ({'/robot/pose': 'pose_stamped', '/vicon/robot': 'transform'}, '/vicon/robot')])
def test_a_measuring_system_is_preferred(topics, chosen, tmp_path, caplog):
    writer = BagBuilder('mcap')
    sequence = open_bag(writer, tmp_path, images(writer), *(
        truth_records(writer, topic, getattr(writer, make)) for topic, make in topics.items()))
    assert len(sequence.ground_truth().trajectory) == COUNT
    assert sequence.sources['ground_truth_topic'] == chosen and not caplog.records


def test_odometry_of_wheels_is_taken_with_a_warning(tmp_path, caplog):
    """Also before /tf, whose transforms may be those of wheels and joints."""
    writer = BagBuilder('mcap')
    joints = [('/tf', stamp, writer.transforms(writer.transform(stamp, pose, 'wheel', 'base')))
              for stamp, pose in zip(STAMPS_NS, make_poses(COUNT, 5))]
    sequence = open_bag(writer, tmp_path, images(writer), joints,
                        truth_records(writer, '/odom', writer.odometry))
    assert_poses(sequence.ground_truth(), 'body', POSES)
    warning, = caplog.records
    assert '/odom is taken for the ground truth, but its name says odometry' in warning.message
    assert 'other candidates: /tf' in warning.message


def test_invalid_poses_of_motion_capture_are_left_out(tmp_path, caplog):
    writer = BagBuilder('mcap')
    records = truth_records(writer, '/truth', writer.pose_stamped)
    records[1][2].pose.position.x = float('nan')
    orientation = records[3][2].pose.orientation
    orientation.x = orientation.y = orientation.z = orientation.w = 0.0
    records[4][2].pose.position.z = 1e200
    truth = open_bag(writer, tmp_path, images(writer), records).ground_truth()
    assert truth.trajectory.stamps_ns.tolist() == [STAMPS_NS[index] for index in (0, 2)]
    np.testing.assert_allclose(truth.trajectory.poses, POSES[[0, 2]], atol=1e-12)
    assert 'left out 3 of 5 poses on /truth' in caplog.text


def test_motion_capture_without_a_valid_pose(tmp_path):
    """The next candidate is taken, where there is one."""
    writer = BagBuilder('mcap')
    records = truth_records(writer, '/truth', writer.pose_stamped)
    for _, _, message in records:
        message.pose.position.x = float('nan')
    assert open_bag(writer, tmp_path, images(writer), records).ground_truth() is None
    requested = open_sequence(str(tmp_path / 'walk'), camera=PINHOLE, ground_truth_topic='/truth')
    with pytest.raises(KfvoError, match='expected a credible pose on /truth, found none'):
        requested.ground_truth()
    records += truth_records(writer, '/zed/pose', writer.pose_stamped)
    other = open_bag(writer, tmp_path / 'two', images(writer), records)
    assert_poses(other.ground_truth(), '/zed/pose', POSES)


@pytest.mark.parametrize('matrix', [2 * np.eye(4), np.diag([1.0, 1, -1, 1]), np.eye(3), 'x'])
def test_a_transform_that_is_not_rigid_is_refused(matrix, tmp_path):
    writer = BagBuilder('mcap')
    with pytest.raises(KfvoError, match='ground truth to camera.*expected a rigid 4x4'):
        open_bag(writer, tmp_path, images(writer), ground_truth_to_camera=matrix)
