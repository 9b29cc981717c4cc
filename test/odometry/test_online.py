# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Online odometry: growing trajectory file, path and covariance."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.errors import KfvoError
from kfvo_ros.odometry import online as module
from kfvo_ros.odometry.factory import make_odometry
from kfvo_ros.odometry.online import (
    MIN_VARIANCE,
    SPREAD_MEMORY,
    OnlineOdometry,
    TrajectoryLog,
    free_path,
)
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.odometry.updates import FramePose, Keyframe, Update
from kfvo_ros.sequences.base import Frame
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.trajectory import UNKNOWN_VARIANCE, read_tum

COUNT = 30
POSES = [geometry.make_transform(geometry.exp_so3(np.array([0.3, -1.2, 0.5]) * index),
                                 np.array([0.4, -0.2, 1.1]) * index) for index in (1, 2, 3)]


@cache
def rendered_frames() -> tuple[Frame, ...]:
    """Return rendered frames of smooth motion, the same objects at every call."""
    return tuple(SyntheticSequence(0, 'smooth', COUNT, 320, 240))


def test_log_grows_on_disk_and_is_saved_with_pending_poses(tmp_path):
    log = TrajectoryLog(tmp_path / 'new' / 'walk.tum')
    log.append([(1, POSES[0]), (2, POSES[1])])
    assert list(read_tum(log.path).stamps_ns) == [1, 2]
    report = log.save(tmp_path / 'copy.tum', [(3, POSES[2])])
    assert report == f'3 poses written to {tmp_path / "copy.tum"}'
    log.append([(4, POSES[0])])  # appended at the end, also after a copy
    log.close()
    assert list(read_tum(log.path).stamps_ns) == [1, 2, 4]
    copy = read_tum(tmp_path / 'copy.tum')
    assert list(copy.stamps_ns) == [1, 2, 3]
    np.testing.assert_allclose(copy.poses, POSES, atol=1e-9)


def test_log_never_overwrites_and_deletes_an_empty_file(tmp_path):
    taken = tmp_path / 'walk.tum'
    taken.write_text('mine')
    for create in (TrajectoryLog, lambda path: TrajectoryLog().save(path, [(1, POSES[0])])):
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


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """Let files grow to `size` bytes: writing fails in the same place as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_log_continues_without_a_gap_when_there_is_room_again(tmp_path):
    log = TrajectoryLog(tmp_path / 'walk.tum')
    with full_disk(100):
        for stamp in range(1, 4):
            log.append([(stamp, POSES[0])])
        assert log.problem == (f'cannot write the trajectory {log.path}: File too large; '
                               '2 poses wait in memory')
        assert list(read_tum(log.path).stamps_ns) == [1]  # no half line
        with pytest.raises(KfvoError, match='cannot write the trajectory .*copy.tum: File too'):
            log.save(tmp_path / 'copy.tum', [])
        assert list(tmp_path.iterdir()) == [log.path]
    assert log.save(tmp_path / 'copy.tum', [(4, POSES[1])]).startswith('4 poses written to ')
    assert list(read_tum(tmp_path / 'copy.tum').stamps_ns) == [1, 2, 3, 4]
    log.append([(4, POSES[1])])
    assert log.problem == ''
    log.close()
    assert list(read_tum(log.path).stamps_ns) == [1, 2, 3, 4]


def test_log_reports_the_poses_that_neither_disk_nor_memory_holds(tmp_path, monkeypatch):
    monkeypatch.setattr(module, 'MAX_WAITING', 3)
    log = TrajectoryLog(tmp_path / 'walk.tum')
    with full_disk(100):
        log.append([(stamp, POSES[0]) for stamp in range(1, 7)])
        assert log.problem.endswith('3 poses wait in memory; 2 poses are missing in it')
    report = log.save(tmp_path / 'copy.tum', [])
    assert report == f'4 poses written to {tmp_path / "copy.tum"}; 2 poses are missing in it'
    log.close()
    assert log.problem == f'the trajectory {log.path}; 2 poses are missing in it'
    assert list(read_tum(log.path).stamps_ns) == [1, 4, 5, 6]


def test_log_in_a_folder_that_cannot_be_made_is_created_later(tmp_path):
    taken = tmp_path / 'out'
    taken.touch()
    log = TrajectoryLog(taken / 'walk.tum', deferred=True)
    log.append([(1, POSES[0])])
    assert log.problem == (f'cannot write the trajectory {taken / "walk.tum"}: File exists; '
                           '1 poses wait in memory')
    taken.unlink()
    log.append([(2, POSES[1])])
    assert log.problem == '' and list(read_tum(log.path).stamps_ns) == [1, 2]
    log.path.unlink()
    log.append([(3, POSES[2])])
    assert 'was deleted' in log.problem
    assert log.save(log.path, []).startswith('3 poses written')
    TrajectoryLog(tmp_path / 'never', deferred=True).close()
    assert not (tmp_path / 'never').exists()


def test_log_without_a_folder_for_temporary_files_is_in_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(module.tempfile, 'tempdir', str(tmp_path / 'missing'))
    log = TrajectoryLog()
    log.append([(1, POSES[0])])
    log.save(tmp_path / 'copy.tum', [(2, POSES[1])])
    log.append([(3, POSES[2])])
    assert log.save(tmp_path / 'all.tum', []).startswith('2 poses')
    assert list(read_tum(tmp_path / 'copy.tum').stamps_ns) == [1, 2]


def test_path_is_the_latest_poses_in_metres():
    whole, short = (OnlineOdometry(make_odometry(OdometryOptions()), TrajectoryLog(), 2.0, length)
                    for length in (None, 5))
    for frame in rendered_frames()[:20]:
        whole.process(frame)
        last = short.process(frame)
        assert len(short.path()) <= 5
    stamps = [stamp for stamp, _ in whole.path()]
    assert stamps == [frame.stamp_ns for frame in rendered_frames()[:20]]
    assert [stamp for stamp, _ in short.path()] == stamps[-5:]
    np.testing.assert_allclose(short.path()[-1][1], last.T_world_camera, atol=1e-9)


def test_covariance_is_the_sum_of_backbone_and_spread():
    """In metres; while no pose is final the spread is zero."""
    scale = np.repeat([3.0, 1.0], 3)
    running = OnlineOdometry(make_odometry(OdometryOptions()), TrajectoryLog(), 3.0)
    odometry, spreads = make_odometry(OdometryOptions()), []
    for frame in rendered_frames():
        pose, update = running.process(frame), odometry.process(frame)
        spread, of_motion = (
            found - np.outer(scale, scale) * given - MIN_VARIANCE * np.eye(6)
            for found, given in ((pose.covariance, update.covariance),
                                 (pose.motion_covariance, update.window_covariance)))
        np.testing.assert_allclose(spread, of_motion, atol=1e-12)
        spreads.append(np.linalg.eigvalsh(spread))
    assert np.abs(spreads[:5]).max() < 1e-12
    assert min(spreads[-1]) > -1e-12 and max(spreads[-1]) > 1e-6


def test_the_spread_between_windows_is_in_world_axes():
    """A frame that faces sideways is refined by a rotation about z of the world."""

    class CorrectingOdometry:
        """Returns frames whose poses become final with a correction."""

        pending: tuple = ()

        def process(self, frame):
            keyframe = Keyframe(None, None, 0, facing, np.zeros((6, 6)))
            pose = FramePose(frame.stamp_ns, keyframe, np.eye(4), True)
            self.pending = (pose,)
            update = Update(frame.stamp_ns, facing, np.zeros((6, 6)), np.zeros((6, 6)), Status.OK,
                            True, self.final, None, {})
            keyframe.T_world_camera = correction @ facing
            self.final = (pose,)
            return update

        final: tuple = ()

    facing = geometry.make_transform(geometry.exp_so3(np.array([0.0, np.pi / 2, 0.0])),
                                     np.array([0.0, 0.0, 0.0]))
    correction = geometry.make_transform(geometry.exp_so3(np.array([0.0, 0.0, 0.1])),
                                         np.array([0.2, 0.0, 0.0]))
    online = OnlineOdometry(CorrectingOdometry(), TrajectoryLog())
    online.process(Frame(1, np.zeros((2, 2), dtype=np.uint8), None))
    pose = online.process(Frame(2, np.zeros((2, 2), dtype=np.uint8), None))
    variances = np.diag(pose.covariance) - MIN_VARIANCE
    np.testing.assert_allclose(variances, SPREAD_MEMORY * np.array([0.04, 0, 0, 0, 0, 0.01]),
                               atol=1e-12)
    assert pose.covariance[0, 5] == pytest.approx(SPREAD_MEMORY * 0.2 * 0.1)


@pytest.mark.parametrize('broken', ['T_world_camera', 'covariance', 'window_covariance'])
def test_a_frame_without_a_finite_pose_is_lost_at_the_last_one(broken, tmp_path):
    """Nothing that is not finite reaches poses, motions, path or files."""
    odometry = make_odometry(OdometryOptions())
    process = odometry.process

    def process_badly(frame: Frame) -> Update:
        update = process(frame)
        if frame.stamp_ns not in bad:
            return update
        if broken == 'T_world_camera':
            odometry._newest.T_world_camera = np.full((4, 4), np.nan)
        return replace(update, **{broken: np.full(np.shape(getattr(update, broken)), np.nan)})

    odometry.process = process_badly
    frames = rendered_frames()[:12]
    bad = {frame.stamp_ns for frame in frames[4:6]}
    online = OnlineOdometry(odometry, TrajectoryLog(tmp_path / 'walk.tum'))
    poses = []
    for frame in frames[:6]:
        poses.append(online.process(frame))
        assert online.failed_in_a_row == (0, 0, 0, 0, 1, 2)[len(poses) - 1]
        assert all(np.isfinite(pose).all() for _, pose in online.path())
    assert [pose.status for pose in poses] == [Status.OK] * 4 + [Status.LOST] * 2
    for pose in poses[4:]:
        assert pose.T_previous_camera is None
        np.testing.assert_array_equal(pose.covariance, UNKNOWN_VARIANCE * np.eye(6))
        np.testing.assert_array_equal(pose.motion_covariance, UNKNOWN_VARIANCE * np.eye(6))
        assert np.isfinite(pose.T_world_camera).all()
    if broken == 'T_world_camera':
        np.testing.assert_array_equal(poses[5].T_world_camera, poses[3].T_world_camera)
    online.finish()
    assert np.isfinite(read_tum(tmp_path / 'walk.tum').poses).all()
    missing = 1 if broken == 'T_world_camera' else 0  # the other was refined
    assert online._log.missing == missing
    assert len(read_tum(tmp_path / 'walk.tum')) == 6 - missing
