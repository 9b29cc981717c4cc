# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services of a running kfvo_node, resets, and the axes of its poses."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest
from node_rig import HEIGHT, WIDTH, Rig, is_origin, make_frames, stamp_ns, std_srvs, to_pose
from ros_processes import wait_until

from kfvo_ros import geometry
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.trajectory import read_tum

STAMPS_NS = [frame.stamp_ns for frame in make_frames()]


@pytest.fixture(scope='module')
def rig(tmp_path_factory):
    """Yield a node for tests that start with a reset; ``rig.file`` is its trajectory file."""
    file = tmp_path_factory.mktemp('saved') / 'walk.tum'
    with Rig(trajectory_file=file) as rig:
        rig.file = file
        yield rig


def test_reset_makes_the_next_image_the_origin(rig):
    rig.reset()
    first = rig.run(make_frames()[:10])
    assert [is_origin(message) for message in first] == [True] + [False] * 9
    assert rig.call(std_srvs.Trigger, 'reset').success
    second = rig.run(make_frames()[10:20])
    assert [is_origin(message) for message in second] == [True] + [False] * 9
    assert 'restarting at the origin: requested' in rig.lines[-2] + rig.lines[-1]


def test_paused_it_processes_nothing(rig):
    rig.reset()
    before = rig.run(make_frames()[:5])
    received = int(rig.state()[2]['images received'])
    answer = rig.call(std_srvs.SetBool, 'pause', data=True)
    assert (answer.success, answer.message) == (True, 'paused')
    rig.send(make_frames()[5:10])
    wait_until(lambda: int(rig.state()[2]['images received']) >= received + 5)
    wait_until(lambda: rig.state()[2]['state'] == 'paused')
    assert rig.state()[:2] == (0, 'paused')
    assert len(rig.odometry()) == len(before)
    answer = rig.call(std_srvs.SetBool, 'pause', data=False)
    assert (answer.success, answer.message) == (True, 'running')
    after = rig.run(make_frames()[10:13])
    assert [stamp_ns(message) for message in after] == STAMPS_NS[10:13]
    assert not is_origin(after[0])  # it continues where it was


def test_save_trajectory_writes_all_poses_to_a_new_file_each_time(rig):
    rig.reset()
    refused = rig.call(std_srvs.Trigger, 'save_trajectory')
    assert (refused.success, refused.message) == (False, 'there is no pose yet')
    files = []
    for begin, end in ((0, 12), (12, 20)):
        rig.run(make_frames()[begin:end])
        answer = rig.call(std_srvs.Trigger, 'save_trajectory')
        count, _, file = answer.message.partition(' poses written to ')
        assert answer.success and int(count) == end
        files.append(Path(file))
    assert [list(read_tum(file).stamps_ns) for file in files] == [
        STAMPS_NS[:count] for count in (12, 20)]
    assert rig.file not in files  # that is the growing one


def test_a_full_disk_is_told_and_no_pose_is_lost(rig):
    """A limit on the size of the node's files simulates it."""
    rig.reset()
    first = rig.run(make_frames()[:1])
    limits = resource.prlimit(rig.process.pid, resource.RLIMIT_FSIZE, (300, -1))
    try:
        rig.run(make_frames()[1:30])
        wait_until(lambda: 'cannot write the trajectory' in rig.state()[1])
        level, summary, _ = rig.state()
        assert level == 1 and 'poses wait in memory' in summary
        answer = rig.call(std_srvs.Trigger, 'save_trajectory')
        assert not answer.success and 'cannot write the trajectory' in answer.message
    finally:
        resource.prlimit(rig.process.pid, resource.RLIMIT_FSIZE, limits)
    rig.run(make_frames()[30:32])
    wait_until(lambda: rig.state()[0] == 0)
    answer = rig.call(std_srvs.Trigger, 'save_trajectory')
    assert answer.success and answer.message.startswith('32 poses written to ')
    saved = Path(answer.message.partition(' written to ')[2])
    assert list(read_tum(saved).stamps_ns) == STAMPS_NS[:32]
    assert not [path for path in saved.parent.iterdir() if path.name.startswith('.')]
    rig.reset()
    logs = [read_tum(path) for path in saved.parent.iterdir() if path.stat().st_size]
    assert sum(list(log.stamps_ns) == STAMPS_NS[:32] for log in logs) == 2
    assert len(first) == 1


def test_stamps_that_go_back_reset(rig):
    rig.reset()
    resets = int(rig.state()[2]['resets'])
    messages = rig.run(make_frames()[:10]) + rig.run(make_frames()[:5])
    assert [index for index, message in enumerate(messages) if is_origin(message)] == [0, 10]
    assert 'went back by 0.300 s' in rig.wait_for_line('the stamps went back')
    for index in (1, 3):  # same images, same poses
        np.testing.assert_allclose(to_pose(messages[10 + index].pose.pose),
                                   to_pose(messages[index].pose.pose), atol=1e-9)
    wait_until(lambda: int(rig.state()[2]['resets']) > resets)


@pytest.mark.parametrize(('step', 'axis', 'sign'), [((0, 0, 0.03), 0, 1), ((0.03, 0, 0), 1, -1)],
                         ids=['forward', 'right'])
def test_axes(rig, step, axis, sign):
    """The camera's z is x of odom, its x is -y of odom."""
    sequence = SyntheticSequence(0, 'smooth', 12, WIDTH, HEIGHT)
    start = sequence.ground_truth().trajectory.poses[0]
    moves = [geometry.make_transform(np.eye(3), index * np.array(step, dtype=float))
             for index in range(sequence.length)]
    sequence._poses = start @ np.array(moves)
    rig.reset()
    position = to_pose(rig.run(list(sequence))[-1].pose.pose)[:3, 3]
    direction = position / np.linalg.norm(position)
    assert direction[axis] * sign > 0.98
    assert np.linalg.norm(position) > 0.02
