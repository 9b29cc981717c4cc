# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of kfvo_node that need no second process."""

from __future__ import annotations

import resource
import threading

import numpy as np
import pytest
from node_rig import make_frames
from ros_processes import wait_until

from kfvo_ros import geometry
from kfvo_ros.assembly import make_odometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.body import T_BODY_OPTICAL, UNKNOWN_VARIANCE, base_pose, body_motion
from kfvo_ros.errors import KfvoError
from kfvo_ros.live import LiveOdometry, LivePose
from kfvo_ros.options import OdometryOptions
from kfvo_ros.ros import monitor as monitoring
from kfvo_ros.ros.messages import make_header
from kfvo_ros.ros.numbering import Numbering
from kfvo_ros.ros.worker import Worker
from kfvo_ros.trajectory import NANOSECONDS, read_tum
from kfvo_ros.trajectory_log import TrajectoryLog, free_path

LEVER = geometry.make_transform(geometry.exp_so3(np.array([0.3, -1.2, 0.5])),
                                np.array([0.4, -0.2, 1.1]))
POSE = geometry.make_transform(geometry.exp_so3(np.array([-0.7, 0.4, 1.9])),
                               np.array([3.0, -2.0, 0.5]))
MOTION = geometry.make_transform(geometry.exp_so3(np.array([0.02, 0.05, -0.03])),
                                 np.array([0.1, 0.02, 0.3]))
INTERVAL_NS = NANOSECONDS // 20


def covariance(seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6))
    return 1e-4 * (root @ root.T + np.eye(6))


def live_pose(pose: np.ndarray, motion: np.ndarray | None = None) -> LivePose:
    return LivePose(7, pose, covariance(1), Status.OK, True, motion,
                    0 if motion is None else INTERVAL_NS, covariance(2))


@pytest.mark.parametrize(('camera', 'base'), [
    ((0, 0, 1), (1, 0, 0)), ((1, 0, 0), (0, -1, 0)), ((0, 1, 0), (0, 0, -1))])
def test_axes_are_those_of_rep_103(camera, base):
    moved = geometry.make_transform(geometry.exp_so3(0.1 * np.array(camera)), np.array(camera))
    pose = base_pose(moved, T_BODY_OPTICAL)
    np.testing.assert_allclose(pose[:3, 3], base, atol=1e-12)
    np.testing.assert_allclose(geometry.log_so3(pose[:3, :3]), 0.1 * np.array(base), atol=1e-12)


def test_a_camera_that_turns_about_the_base_leaves_it_in_its_place():
    turn = geometry.make_transform(geometry.exp_so3(np.array([0.0, 0.0, 0.8])), np.zeros(3))
    T_world_camera = geometry.invert(LEVER) @ turn @ LEVER
    assert np.linalg.norm(T_world_camera[:3, 3]) > 0.1
    np.testing.assert_allclose(base_pose(T_world_camera, LEVER), turn, atol=1e-12)


def test_covariance_is_carried_over_the_lever():
    """Against numerical derivatives: errors turn and shift the camera in the world."""
    motion = body_motion(live_pose(POSE), LEVER)
    columns, small = [], 1e-6
    for error in small * np.eye(6):
        moved = geometry.make_transform(geometry.exp_so3(error[3:]) @ POSE[:3, :3],
                                        POSE[:3, 3] + error[:3])
        base = base_pose(moved, LEVER)
        turn = base[:3, :3] @ motion.T_odom_base[:3, :3].T
        columns.append(np.append(base[:3, 3] - motion.T_odom_base[:3, 3],
                                 geometry.log_so3(turn)) / small)
    jacobian = np.array(columns).T
    np.testing.assert_allclose(motion.covariance, jacobian @ covariance(1) @ jacobian.T,
                               rtol=1e-4, atol=1e-8)


def test_twist_is_the_finite_difference_in_the_frame_of_the_base():
    before, now = base_pose(POSE, LEVER), base_pose(POSE @ MOTION, LEVER)
    motion = body_motion(live_pose(POSE @ MOTION, MOTION), LEVER)
    seconds = INTERVAL_NS / NANOSECONDS
    linear = now[:3, :3].T @ (now[:3, 3] - before[:3, 3]) / seconds
    angular = geometry.log_so3(before[:3, :3].T @ now[:3, :3]) / seconds
    np.testing.assert_allclose(motion.twist, np.append(linear, angular), atol=1e-9)
    plain = body_motion(live_pose(POSE @ MOTION, MOTION), T_BODY_OPTICAL)  # no lever
    np.testing.assert_allclose(np.linalg.eigvalsh(plain.twist_covariance),
                               np.linalg.eigvalsh(covariance(2)) / seconds ** 2)


def test_of_the_first_velocity_nothing_is_known():
    motion = body_motion(live_pose(POSE), LEVER)
    assert not motion.twist.any()
    assert (motion.twist_covariance == UNKNOWN_VARIANCE * np.eye(6)).all()


def test_log_grows_on_disk_and_is_saved_with_what_is_not_final(tmp_path):
    log = TrajectoryLog(tmp_path / 'new' / 'walk.tum')
    log.append([(1, POSE), (2, MOTION)])
    assert list(read_tum(log.path).stamps_ns) == [1, 2]
    assert log.save(tmp_path / 'copy.tum', [(3, LEVER)]) == 3
    log.append([(4, POSE)])  # after a copy it goes on at the end
    log.close()
    assert list(read_tum(log.path).stamps_ns) == [1, 2, 4]
    copy = read_tum(tmp_path / 'copy.tum')
    assert list(copy.stamps_ns) == [1, 2, 3]
    np.testing.assert_allclose(copy.poses, [POSE, MOTION, LEVER], atol=1e-9)


def test_log_overwrites_nothing_and_leaves_no_empty_file(tmp_path):
    taken = tmp_path / 'walk.tum'
    taken.write_text('mine')
    for create in (TrajectoryLog, lambda path: TrajectoryLog().save(path, [(1, POSE)])):
        with pytest.raises(KfvoError, match='cannot write the trajectory .*walk.tum'):
            create(taken)
        with pytest.raises(KfvoError, match='cannot write the trajectory'):
            create(taken / 'below' / 'a-file.tum')
    assert taken.read_text() == 'mine'
    assert free_path(taken) == tmp_path / 'walk-1.tum'
    TrajectoryLog(free_path(taken)).close()
    assert list(tmp_path.iterdir()) == [taken]
    (tmp_path / 'walk-1.tum').touch()
    assert free_path(taken) == tmp_path / 'walk-2.tum'


def test_log_survives_a_full_disk(tmp_path):
    """A limit on the size of files stands in for it: writing fails in the same place."""
    log = TrajectoryLog(tmp_path / 'walk.tum')
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        for stamp in range(1, 4):
            log.append([(stamp, POSE)])
        log.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert str(log.problem) == (f'cannot write the trajectory {tmp_path / "walk.tum"}: '
                                'File too large')


def test_path_is_the_newest_of_the_poses_in_metres():
    whole, short = (LiveOdometry(make_odometry(OdometryOptions()), TrajectoryLog(), 2.0, length)
                    for length in (None, 5))
    for frame in make_frames()[:20]:
        whole.process(frame)
        last = short.process(frame)
        assert len(short.path()) <= 5
    stamps = [stamp for stamp, _ in whole.path()]
    assert stamps == [frame.stamp_ns for frame in make_frames()[:20]]
    assert [stamp for stamp, _ in short.path()] == stamps[-5:]
    np.testing.assert_allclose(short.path()[-1][1], last.T_world_camera, atol=1e-9)


def test_worker_takes_the_newest_and_counts_what_is_dropped():
    taken, idle, gate = [], threading.Event(), threading.Event()

    def work(item: int) -> None:
        taken.append(item)
        gate.wait(10.0)

    worker = Worker(work, idle.set, 2, 0.05)
    worker.start()
    assert worker.put(0) == 0
    wait_until(lambda: taken)
    assert [worker.put(item) for item in range(1, 6)] == [0, 0, 1, 1, 1]
    assert not idle.is_set()
    gate.set()
    wait_until(idle.is_set)
    worker.stop()
    assert taken == [0, 4, 5]


@pytest.mark.parametrize('publishers', [1, 2, 3])
@pytest.mark.parametrize('seed', range(20))
def test_lost_messages_are_counted_whoever_sent_them(publishers, seed):
    """Each publisher's numbers rise from somewhere; nobody tells which are whose."""
    random = np.random.default_rng(seed)
    streams, lost = [], 0
    for _ in range(publishers):
        came = random.random(100) < 0.7
        came[[0, -1]] = True  # what was lost before and after these, nobody can know
        numbers = random.choice([1, 1000]) + np.flatnonzero(came)
        lost += int((~came).sum())
        streams.append(list(map(int, numbers)))
    numbering, found = Numbering(), 0
    numbering.begin(publishers)
    found += sum(numbering.missing(stream.pop(0)) for stream in streams)
    while any(streams):
        stream = streams[random.choice([i for i, left in enumerate(streams) if left])]
        found += numbering.missing(stream.pop(0))
    assert lost > 10 and found == lost


def test_publishers_that_come_anew_lost_nothing():
    numbering = Numbering()
    numbering.begin(1)
    assert [numbering.missing(number) for number in (7, 8, 11)] == [0, 0, 2]
    numbering.begin(1)  # it was started again
    assert [numbering.missing(number) for number in (30, 31, 33)] == [0, 0, 1]
    assert [numbering.missing(number) for number in (1, 2, 4)] == [0, 0, 1]  # untold
    numbering.begin(2)
    assert [numbering.missing(number) for number in (5, 500, 6, 503)] == [0, 0, 0, 2]
    assert numbering.missing(None) == 0


def test_monitor_tells_what_is_wrong(monkeypatch):
    monitor = monitoring.Monitor()

    def told() -> tuple[int, str]:
        status, = monitor.message(make_header(1, ''), 'name', '/image', {}).status
        return int.from_bytes(status.level, 'little'), status.message

    assert told() == (0, 'waiting for the first image')
    monitor.posed(monitor.image(), Status.OK, True)
    assert told() == (0, 'tracking')
    monitor.problem = 'garbage'
    assert told() == (1, 'garbage')
    monitor.posed(monitor.image(), Status.LOST, False)
    assert told() == (1, 'lost')
    assert (monitor.received, monitor.processed, monitor.keyframes, monitor.lost) == (2, 2, 1, 1)
    monkeypatch.setattr(monitoring, 'SILENCE_S', -1.0)
    assert told() == (1, 'no image on /image for 0 s')
    monitor.paused = True
    assert told() == (0, 'paused')
