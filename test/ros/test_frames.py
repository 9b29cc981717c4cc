# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TF: the camera's place on the base is looked up in a tree, and the base's pose is sent."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from math import cos, pi, sin
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from node_rig import DIAGNOSTICS, Rig, make_frames, stamp_ns, to_pose
from ros_processes import Listener, environment, wait_until

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.errors import KfvoError
from kfvo_ros.odometry.base_motion import base_motion
from kfvo_ros.odometry.factory import make_odometry
from kfvo_ros.odometry.online import OnlineOdometry, OnlinePose, TrajectoryLog
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.ros import frames as module
from kfvo_ros.ros.messages import make_transform_message, to_transform
from kfvo_ros.ros.options import NodeOptions
from kfvo_ros.ros.publishers import Publishers
from kfvo_ros.trajectory import NANOSECONDS

geometry_msgs = pytest.importorskip('geometry_msgs.msg')
Time = pytest.importorskip('rclpy.time').Time

FAKE_TF2 = Path(__file__).parents[1] / 'fake_tf2'
FRAMES = make_frames()[:16]
COSINE, SINE = cos(pi / 6), sin(pi / 6)
T_BASE_LENS = np.array([
    [1.0, 0.0, 0.0, 0.18], [0.0, -SINE, COSINE, 0.03 * COSINE + 0.01 * SINE],
    [0.0, -COSINE, -SINE, 1.05 - 0.03 * SINE + 0.01 * COSINE], [0.0, 0.0, 0.0, 1.0]])
"""Of a mast that turned left by 90 degrees, whose camera looks down by 30."""


@pytest.fixture
def tf2_ros(monkeypatch) -> ModuleType:
    """Return the fake tf2_ros, as which `kfvo_ros.ros.frames` has imported it."""
    spec = importlib.util.spec_from_file_location('tf2_ros', FAKE_TF2 / 'tf2_ros.py')
    fake = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, 'tf2_ros', fake)
    spec.loader.exec_module(fake)
    monkeypatch.setattr(module, 'tf2_ros', fake)
    return fake


def make_edge(parent: str, child: str, translation: tuple[float, float, float],
              rotation: np.ndarray, seconds: int):
    """Return T_parent_child of a rotation vector as TF has it."""
    return make_transform_message(seconds * NANOSECONDS, parent, child, geometry.make_transform(
        geometry.exp_so3(rotation), np.array(translation)))


def make_tree() -> list:
    """Return a recorded tree: base_link, a mast that turns, camera_link, lens."""
    optical = make_edge('camera_link', 'lens', (0.03, 0.02, 0.01), np.zeros(3), 10)
    rotation = optical.transform.rotation
    rotation.x, rotation.y, rotation.z, rotation.w = -0.5, 0.5, -0.5, 0.5
    return [make_edge('base_link', 'mast', (0.2, -0.1, 1.0), np.zeros(3), 10),
            make_edge('base_link', 'mast', (0.2, -0.1, 1.0), np.array([0.0, 0.0, pi / 2]), 20),
            make_edge('mast', 'camera_link', (0.1, 0.0, 0.05), np.array([0.0, pi / 6, 0.0]), 10),
            optical, make_edge('map', 'odom', (5.0, 0.0, 0.0), np.array([0.0, 0.0, 1.0]), 10)]


def test_camera_pose_in_the_base_is_the_latest_of_the_tree(tf2_ros):
    with Listener({}) as robot, Listener({}) as listener:
        base = module.BaseFrame(listener.node, NodeOptions(base_frame='base_link'))
        unconnected = module.BaseFrame(listener.node, NodeOptions(base_frame='map'))
        assert base.name('lens') == 'base_link'
        assert base.transform('lens') is None
        problem = base.problem('lens')
        assert 'from base_link to lens' in problem and 'set base_to_camera' in problem
        broadcaster = tf2_ros.TransformBroadcaster(robot.node)
        for edge in make_tree():
            broadcaster.sendTransform(edge)
        wait_until(lambda: base.transform('lens') is not None)
        np.testing.assert_allclose(base.transform('lens'), T_BASE_LENS, atol=1e-12)
        wait_until(lambda: unconnected._buffer.can_transform('map', 'odom', Time()))
        assert unconnected.transform('lens') is None


@pytest.mark.parametrize('enabled', [True, False])
def test_sender_sends_transforms_unchanged_if_enabled(tf2_ros, enabled):
    sent = make_edge('odom', 'base_link', (1.0, -2.0, 0.5), np.array([0.3, -1.2, 0.5]), 7)
    with Listener({tf2_ros.TOPIC: geometry_msgs.TransformStamped}, tf2_ros.QOS) as listener:
        sender = module.TransformSender(listener.node, enabled)
        sender.send(sent)
        if enabled:
            wait_until(lambda: listener.messages(tf2_ros.TOPIC))
            assert listener.messages(tf2_ros.TOPIC) == [sent]
        else:
            assert listener.node.count_publishers(tf2_ros.TOPIC) == 0


def test_node_publishes_nothing_until_tf_is_known_and_then_the_base(tf2_ros):
    """Poses, twists and covariances of the base; TF from odom to base_link with the same pose."""
    online = OnlineOdometry(make_odometry(OdometryOptions()), TrajectoryLog())
    expected = [base_motion(online.process(frame), T_BASE_LENS) for frame in FRAMES]
    tf = Listener({tf2_ros.TOPIC: geometry_msgs.TransformStamped}, tf2_ros.QOS)
    with tf, Rig(env=environment(FAKE_TF2), base_frame='base_link') as rig:
        rig.send(FRAMES[:4])
        rig.wait_for_line('no transform from base_link to lens')
        rig.wait_for_value('poses withheld', 4)
        assert not rig.odometry() and not tf.messages(tf2_ros.TOPIC)
        broadcaster = tf2_ros.TransformBroadcaster(tf.node)
        for edge in make_tree():
            broadcaster.sendTransform(edge)
        count = len(rig.listener.messages(DIAGNOSTICS))  # sent each second, after the tree came
        wait_until(lambda: len(rig.listener.messages(DIAGNOSTICS)) >= count + 2)
        messages = rig.run(FRAMES[4:])
        rig.wait_for_line('frames: odom -> base_link, images in lens')

        def from_odom() -> list:
            return [message for message in tf.messages(tf2_ros.TOPIC)
                    if message.header.frame_id == 'odom']

        wait_until(lambda: len(from_odom()) == len(messages))
        sent = from_odom()
    assert [stamp_ns(message) for message in messages] == [
        frame.stamp_ns for frame in FRAMES[4:]]
    for message, transform, motion in zip(messages, sent, expected[4:], strict=True):
        assert (message.header.frame_id, message.child_frame_id) == ('odom', 'base_link')
        pose = to_pose(message.pose.pose)
        np.testing.assert_allclose(pose, motion.T_odom_base, atol=1e-9)
        np.testing.assert_allclose(np.reshape(message.pose.covariance, (6, 6)),
                                   motion.covariance, rtol=1e-6, atol=1e-12)
        twist = message.twist.twist
        np.testing.assert_allclose(
            [getattr(part, axis) for part in (twist.linear, twist.angular) for axis in 'xyz'],
            motion.twist, atol=1e-7)
        np.testing.assert_allclose(np.reshape(message.twist.covariance, (6, 6)),
                                   motion.twist_covariance, rtol=1e-6, atol=1e-9)
        assert (transform.header, transform.child_frame_id) == (message.header, 'base_link')
        np.testing.assert_allclose(to_transform(transform), pose, atol=1e-12)
    assert np.abs(expected[-1].T_odom_base - np.eye(4)).max() > 0.01


class FakeBuffer:
    """A TF buffer with T_base_camera by camera frame."""

    def __init__(self, transforms: dict[str, np.ndarray]) -> None:
        self.transforms = transforms

    def lookup_transform(self, base: str, camera: str, time: Time):
        if camera not in self.transforms:
            raise module.tf2_ros.TransformException(camera)
        return make_transform_message(0, base, camera, self.transforms[camera])


def make_pose(stamp_ns: int) -> OnlinePose:
    return OnlinePose(stamp_ns, np.eye(4), np.eye(6), Status.OK, True, None, 0, np.eye(6))


def test_transform_is_that_of_the_camera_and_of_the_segment(tf2_ros):
    """A mount that moves during a segment is a problem; the next segment looks again."""
    shifted = T_BASE_LENS + np.outer([0.1, 0.0, 0.0, 0.0], [0, 0, 0, 1])
    with Listener({}) as listener:
        publishers = Publishers(listener.node, NodeOptions(base_frame='base_link'))
        tree = publishers._base._buffer = FakeBuffer({'left': T_BASE_LENS})
        assert publishers.publish(make_pose(1), 'right').startswith('no transform from base_link')
        assert publishers.publish(make_pose(2), 'left') == ''
        np.testing.assert_allclose(publishers._T_base_camera, T_BASE_LENS, atol=1e-12)
        tree.transforms['right'] = shifted
        assert publishers.publish(make_pose(3), 'right') == publishers.problem == ''
        np.testing.assert_allclose(publishers._T_base_camera, shifted, atol=1e-12)
        tree.transforms['right'] = T_BASE_LENS
        assert publishers.publish(make_pose(4), 'right') == ''
        assert publishers.problem.startswith('right moves on base_link, so the poses')
        np.testing.assert_allclose(publishers._T_base_camera, shifted, atol=1e-12)
        publishers.start_segment()
        assert publishers.publish(make_pose(5), 'right') == publishers.problem == ''
        np.testing.assert_allclose(publishers._T_base_camera, T_BASE_LENS, atol=1e-12)
        tree.transforms['right'] = np.full((4, 4), np.nan)
        publishers.start_segment()
        assert publishers.publish(make_pose(6), 'right').startswith('no transform')


def test_poses_that_are_not_finite_are_not_published():
    with Listener({}) as listener:
        publishers = Publishers(listener.node, NodeOptions(publish_tf=False))
        endless = replace(make_pose(1), covariance=np.full((6, 6), np.inf))
        assert publishers.publish(endless, 'lens') == 'the pose of lens_body is not finite'
        assert publishers.publish(make_pose(2), 'lens') == ''
        with pytest.raises(KfvoError, match='images are in odom and poses in odom'):
            publishers.publish(make_pose(3), 'odom')


@pytest.mark.parametrize(('given', 'names', 'line'), [
    ({}, ('odom', '', ''), None),
    ({'odom_frame': '/odom', 'base_frame': 'base_link'}, ('odom', 'base_link', ''),
     "odom_frame: frames of TF have no leading slash: '/odom' is used as odom"),
    ({'camera_frame': '//lens'}, ('odom', '', 'lens'), "'//lens' is used as lens"),
    ({'base_frame': 'lens', 'camera_frame': 'lens'}, ('odom', 'lens', 'lens'), 'optical frame')])
def test_frame_names_are_those_of_tf(given, names, line):
    lines: list[str] = []
    checked = module.check_frames(NodeOptions(**given), lines.append)
    assert (checked.odom_frame, checked.base_frame, checked.camera_frame) == names
    assert [line in each for each in lines] == ([True] if line else [])


@pytest.mark.parametrize(('given', 'problem'), [
    ({'odom_frame': ''}, "parameter odom_frame: expected the name of a frame, came ''"),
    ({'base_frame': '/'}, "parameter base_frame: expected the name of a frame, came '/'"),
    ({'base_frame': '/odom'}, 'odom_frame and base_frame: expected two frames, both are odom'),
    ({'camera_frame': 'odom'}, 'odom_frame and camera_frame: expected two frames')])
def test_impossible_frame_names_are_errors(given, problem):
    with pytest.raises(KfvoError, match=problem):
        module.check_frames(NodeOptions(**given), lambda line: None)
