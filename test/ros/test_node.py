# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.node`` in a process of its own: topics, signals, parameters."""

from __future__ import annotations

import re
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from node_rig import (
    COUNT,
    DIAGNOSTICS,
    KEYFRAME,
    NODE,
    ODOMETRY,
    PATH,
    Rig,
    diagnostic_msgs,
    make_frames,
    stamp_ns,
    to_pose,
)
from ros_processes import Listener, run_module, running_module, wait_until

from kfvo_ros import geometry
from kfvo_ros.odometry.base_motion import T_BODY_OPTICAL, base_pose
from kfvo_ros.odometry.factory import make_odometry
from kfvo_ros.odometry.online import OnlineOdometry, TrajectoryLog
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.trajectory import NANOSECONDS, read_tum
from kfvo_ros.utils.process import time_limit

PATH_LENGTH = 15
BASE_TO_CAMERA = (0.4, -0.2, 1.1, 0.5, -0.1, 0.7, 0.5)
STAMPS_NS = [frame.stamp_ns for frame in make_frames()]


@pytest.fixture(scope='module')
def online(tmp_path_factory) -> SimpleNamespace:
    """Return messages, log and files of a node that processed the whole walk."""
    file = tmp_path_factory.mktemp('online') / 'deep' / 'walk.tum'
    with Rig(trajectory_file=file, path_max_length=PATH_LENGTH, path_rate=20.0) as rig:
        messages = rig.run(make_frames())
        rig.wait_for_value('images processed', COUNT)
        wait_until(lambda: stamp_ns(rig.listener.messages(PATH)[-1]) == STAMPS_NS[-1])
        state, paths = rig.state(), rig.listener.messages(PATH)
        keyframes = rig.listener.messages(KEYFRAME)
        topics = dict(rig.listener.node.get_publisher_names_and_types_by_node('kfvo', '/'))
        took = rig.stop()
    return SimpleNamespace(messages=messages, state=state, paths=paths, took=took, file=file,
                           code=rig.process.returncode, lines=rig.lines, topics=topics,
                           keyframes=keyframes)


@pytest.fixture(scope='module')
def offline(tmp_path_factory) -> SimpleNamespace:
    """Return the same walk without ROS: poses at arrival, the last path, the final poses."""
    file = tmp_path_factory.mktemp('offline') / 'walk.tum'
    live = OnlineOdometry(make_odometry(OdometryOptions()), TrajectoryLog(file), 1.0, PATH_LENGTH)
    arrivals = [live.process(frame).T_world_camera for frame in make_frames()]
    path = live.path()
    live.finish()
    return SimpleNamespace(arrivals=arrivals, path=path, final=read_tum(file))


def test_one_odometry_per_image_with_its_stamp(online, offline):
    assert [stamp_ns(message) for message in online.messages] == STAMPS_NS
    assert {(message.header.frame_id, message.child_frame_id)
            for message in online.messages} == {('odom', 'lens_body')}
    for message, arrival in zip(online.messages, offline.arrivals, strict=True):
        q = message.pose.pose.orientation
        assert abs(np.linalg.norm([q.x, q.y, q.z, q.w]) - 1.0) < 1e-12
        np.testing.assert_allclose(to_pose(message.pose.pose),
                                   base_pose(arrival, T_BODY_OPTICAL), atol=1e-9)
    np.testing.assert_allclose(to_pose(online.messages[0].pose.pose), np.eye(4), atol=1e-12)


@pytest.mark.parametrize('part', ['pose', 'twist'])
def test_covariances_are_positive_definite_and_depend_on_the_data(online, part):
    found = np.array([getattr(message, part).covariance for message in online.messages])
    for matrix in found.reshape(-1, 6, 6):
        assert (matrix == matrix.T).all()
        assert np.linalg.eigvalsh(matrix)[0] > 0.0
    assert len(np.unique(found[2:, 0])) > COUNT // 2
    assert found[-1, 0] < 1.0


def test_twist_is_the_motion_since_the_previous_image(online):
    """In the axes of the base; only the refinement of the previous frame may differ."""
    differences, twists = [], []
    for before, message in zip(online.messages[:-1], online.messages[1:], strict=True):
        moved = geometry.relative(to_pose(before.pose.pose), to_pose(message.pose.pose))
        seconds = (stamp_ns(message) - stamp_ns(before)) / NANOSECONDS
        differences.append(np.append(moved[:3, :3].T @ moved[:3, 3],
                                     geometry.log_so3(moved[:3, :3])) / seconds)
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        twists.append([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
    misfit = np.linalg.norm(np.array(twists) - differences, axis=1)
    assert np.median(misfit) < 0.2 * np.median(np.linalg.norm(twists, axis=1))


def test_path_is_refined_and_bounded(online, offline):
    assert max(len(path.poses) for path in online.paths) == PATH_LENGTH
    last = online.paths[-1]
    assert last.header.frame_id == 'odom'
    assert [stamp_ns(pose) for pose in last.poses] == STAMPS_NS[-PATH_LENGTH:]
    for pose, (stamp, T_world_camera) in zip(last.poses, offline.path, strict=True):
        assert stamp_ns(pose) == stamp
        np.testing.assert_allclose(to_pose(pose.pose), base_pose(T_world_camera, T_BODY_OPTICAL),
                                   atol=1e-9)
    arrival = [to_pose(message.pose.pose) for message in online.messages[-PATH_LENGTH:]]
    assert not np.allclose([to_pose(pose.pose) for pose in last.poses], arrival, atol=1e-6)


def test_diagnostics_count(online):
    level, summary, values = online.state
    assert (level, summary) == (0, 'tracking')
    counted = ('images lost in transit', 'images received', 'images processed', 'images dropped',
               'images refused', 'resets')
    assert [values[key] for key in counted] == ['0', str(COUNT), str(COUNT), '0', '0', '0']
    assert 1 <= int(values['keyframes']) <= COUNT
    assert float(values['latency median [ms]']) > 0.0 and float(values['memory [MiB]']) > 10.0
    assert (values['backbone'], values['keyframe policy']) == ('geometric', 'learned')


def test_keyframes_repeat_the_pose_of_their_odometry(online):
    stamps = [stamp_ns(message) for message in online.keyframes]
    assert str(len(stamps)) == online.state[2]['keyframes'] and 0 < len(stamps) < COUNT
    poses = {stamp_ns(message): message.pose.pose for message in online.messages}
    assert [message.pose for message in online.keyframes] == [poses[stamp] for stamp in stamps]
    assert {message.header.frame_id for message in online.keyframes} == {'odom'}


def test_trajectory_file_equals_that_of_offline_odometry(online, offline):
    written = read_tum(online.file)
    assert list(written.stamps_ns) == STAMPS_NS
    np.testing.assert_allclose(written.poses, offline.final.poses, atol=1e-9)
    assert not np.allclose(written.poses, offline.arrivals, atol=1e-6)  # it is refined


@pytest.mark.parametrize(('file', 'shown'), [
    ('rviz/kfvo.rviz', {ODOMETRY, PATH}),
    ('foxglove/kfvo.json', {ODOMETRY, PATH, KEYFRAME, DIAGNOSTICS})])
def test_viewer_layouts_show_published_topics(online, file, shown):
    text = (Path(__file__).parents[2] / file).read_text()
    assert set(re.findall(r'/(?:kfvo/\w+|diagnostics)', text)) == shown <= set(online.topics)


def test_log_holds_information_only(online):
    assert (online.code, online.took < time_limit(2.0)) == (0, True)
    problems = [line for line in online.lines if '[INFO]' not in line and 'tf2_ros' not in line]
    assert problems == []


def test_poses_of_a_base_with_base_to_camera(offline):
    """In odometry and path: odom is the base, not the camera, at the first image."""
    T_base_camera = geometry.transform_from_xyz_quat(np.array(BASE_TO_CAMERA))
    with Rig(base_frame='base_link', base_to_camera=' '.join(map(str, BASE_TO_CAMERA)),
             path_rate=20.0) as rig:
        messages = rig.run(make_frames()[:12])
        wait_until(lambda: stamp_ns(rig.listener.messages(PATH)[-1]) == STAMPS_NS[11])
        path = rig.listener.messages(PATH)[-1]
    assert {(message.header.frame_id, message.child_frame_id)
            for message in messages} == {('odom', 'base_link')}
    expected = T_base_camera @ np.array(offline.arrivals[:12]) @ np.linalg.inv(T_base_camera)
    found = [to_pose(message.pose.pose) for message in messages]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(to_pose(path.poses[-1].pose), expected[-1], atol=1e-9)
    np.testing.assert_allclose(to_pose(path.poses[0].pose), np.eye(4), atol=1e-12)


@pytest.mark.parametrize('sent', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_work_ends_it_with_status_0(sent, tmp_path):
    file = tmp_path / 'walk.tum'
    with Rig(trajectory_file=file) as rig:
        rig.send(make_frames())
        rig.odometry(12)
        assert rig.stop(sent) < time_limit(2.0)
        assert rig.process.returncode == 0
        assert 'Traceback' not in ''.join(rig.lines)
        count = len(rig.odometry())
    written = list(read_tum(file).stamps_ns)
    assert written == STAMPS_NS[:len(written)]
    assert len(written) >= count  # the last message may be lost in transit


@pytest.mark.parametrize(('parameter', 'parts'), [
    ('window_size:=many', ['window_size', 'a whole number', "'many'"]),
    ('publish_tf:=1', ['publish_tf', 'true or false', '1']),
    ('window_size:=2', ['window_size', 'at least 3', '2']),
    ('survival_share:=1.5', ['survival_share', 'at most 1', '1.5']),
    ('keyframes:=sometimes', ['keyframes', 'every, optical_flow', "'sometimes'"]),
    ('camera_info_file:=/no/such.yaml', ['/no/such.yaml']),
    ('image_topic:=[]', ['image_topic', 'expected text', 'an empty list']),
    ('scale_rule:=[]', ['scale_rule', 'one of none', 'an empty list']),
    ('trajectory_file:=/tmp', ['trajectory_file', 'expected a file', 'the folder /tmp']),
    ('odom_frame:="/"', ['odom_frame', 'the name of a frame']),
    ('base_to_camera:="0 0 0 0 0 0 1"', ['base_to_camera', 'base_frame']),
    ('base_frame:=base_link', ['base_link', 'tf2_ros', 'base_to_camera']),
])
def test_an_invalid_parameter_ends_in_one_line(parameter, parts):
    if 'tf2_ros' in parts:
        try:
            import tf2_ros  # noqa: F401
            pytest.skip('tf2_ros is installed')
        except ImportError:
            pass
    done = run_module(NODE, '--ros-args', '-p', parameter)
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    line, = [line for line in done.stderr.splitlines() if 'error:' in line]
    assert all(part in line for part in parts), line


def test_unknown_parameters_are_logged_and_integers_are_valid_numbers():
    """A scale of 3, not 3.0; it multiplies the poses at scale 1."""
    with Rig(scale=3, keyframe='every', nonsense=1) as rig:
        assert 'is keyframes meant?' in rig.wait_for_line('unknown parameter keyframe:')
        assert 'expected one of' in rig.wait_for_line('unknown parameter nonsense:')
        scaled = to_pose(rig.run(make_frames()[:8])[-1].pose.pose)
    odometry = make_odometry(OdometryOptions())
    plain = [odometry.process(frame).T_world_camera for frame in make_frames()[:8]][-1]
    np.testing.assert_allclose(scaled[:3, 3], 3.0 * (T_BODY_OPTICAL @ plain)[:3, 3], atol=1e-9)


def test_a_parameter_file_for_another_node_is_named_with_its_keys(tmp_path):
    """A file with a section for this node is not, whatever else it holds."""
    other, own = tmp_path / 'other.yaml', tmp_path / 'own.yaml'
    other.write_text('ns:\n  camera:\n    ros__parameters: {image_topic: /a, window_size: 5}\n')
    own.write_text('/*:\n  ros__parameters: {nothing: []}\nother:\n  ros__parameters: {a: 1}\n')
    with running_module(NODE, '--ros-args', '--params-file', other, '--params-file',
                        own) as process:
        lines = []
        while not lines or 'ready' not in lines[-1]:
            lines.append(process.stderr.readline())
        lines.append(process.stderr.readline())
    ignored, = [line for line in lines if 'is ignored' in line]
    assert f'{other} has no parameters of /kfvo' in ignored
    assert 'image_topic, window_size of /ns/camera' in ignored
    assert any('unknown parameter nothing' in line for line in lines)


def test_a_namespace_is_part_of_the_name_in_diagnostics():
    with Listener({DIAGNOSTICS: diagnostic_msgs.DiagnosticArray}) as listener, running_module(
            NODE, '--ros-args', '-r', '__ns:=/left/robot'):
        wait_until(lambda: listener.messages(DIAGNOSTICS))
    status, = listener.messages(DIAGNOSTICS)[0].status
    assert status.name == 'left/robot/kfvo: odometry'


def test_only_the_newest_image_waits_by_default():
    """A camera faster than the node: images are dropped, but never the last one."""
    with Rig(process_every_frame=False) as rig:
        for frame in make_frames():
            rig.send([frame])
            time.sleep(0.002)
        wait_until(lambda: stamp_ns(rig.odometry(1)[-1]) == STAMPS_NS[-1])
        processed = {stamp_ns(message) for message in rig.odometry()}
        rig.wait_for_value('images processed', len(processed))
        values = {key: int(rig.state()[2][f'images {key}']) for key in ('received', 'dropped')}
    assert values['dropped'] > 0 and len(processed) < COUNT
    assert values['dropped'] + len(processed) == values['received']


def test_a_removed_folder_loses_the_trajectory_file_only(tmp_path):
    folder = tmp_path / 'out'
    with Rig(trajectory_file=folder / 'walk.tum') as rig:
        rig.run(make_frames()[:5])
        folder.rename(tmp_path / 'away')
        folder.touch()
        rig.reset()
        assert len(rig.run(make_frames()[5:10])) == 5
        assert str(folder) in rig.wait_for_line('cannot write the trajectory')
        rig.reset()
        assert len(rig.run(make_frames()[10:15])) == 5
        rig.stop()
        assert rig.process.returncode == 0
    assert len(read_tum(tmp_path / 'away' / 'walk.tum')) == 5
