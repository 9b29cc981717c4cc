# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps without floats, association in time, and trajectory files."""

from __future__ import annotations

from decimal import Decimal

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.trajectory import (
    Trajectory,
    associate,
    format_stamp,
    format_tum_line,
    parse_stamp_ns,
    read_kitti_poses,
    read_tum,
)

EPOCH_NS = 1_403_715_273_262_142_976


def random_trajectory(count: int = 20, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    rotations = geometry.rotation_from_quat_xyzw(rng.normal(size=(count, 4)))
    poses = geometry.make_transform(rotations, rng.normal(scale=50.0, size=(count, 3)))
    return Trajectory(EPOCH_NS + np.cumsum(rng.integers(1, 10 ** 8, count)), poses)


# Stamps


@pytest.mark.parametrize('text, stamp_ns', [
    ('0', 0), ('1', 10 ** 9), ('1.5', 1_500_000_000), ('.5', 500_000_000), ('5.', 5 * 10 ** 9),
    ('-0.5', -500_000_000), ('-.5', -500_000_000), ('+2.25', 2_250_000_000),
    ('  7.000000001\n', 7_000_000_001), ('1403715273.262142976', EPOCH_NS),
    ('1.403715273262142976e9', EPOCH_NS), ('1.036224e-01', 103_622_400),
    ('1.5E+2', 150 * 10 ** 9), ('1e-9', 1), ('1e-10', 0), ('1e-400', 0),
    ('0.9999999999', 999_999_999), ('-0.0000000019', -1)])
def test_stamps_are_parsed_exactly(text, stamp_ns):
    assert parse_stamp_ns(text) == stamp_ns


def test_random_decimal_numbers_are_parsed_exactly():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        whole = str(rng.integers(0, 10 ** int(rng.integers(1, 9))))
        fraction = ''.join(map(str, rng.integers(0, 10, rng.integers(0, 14))))
        text = (rng.choice(['', '-', '+']) + whole + ('.' + fraction if fraction else '')
                + rng.choice(['', 'e0', 'e-3', 'E+1', 'e-12']))
        assert parse_stamp_ns(text) == int(Decimal(text) * 10 ** 9), text


def test_stamps_survive_the_round_trip():
    rng = np.random.default_rng(1)
    near_now = EPOCH_NS + rng.integers(-10 ** 9, 10 ** 9, 500)
    anywhere = rng.integers(-2 ** 63 + 1, 2 ** 63 - 1, 500)
    for stamp_ns in [0, 1, -1, 10 ** 9, -10 ** 9, *near_now, *anywhere]:
        assert parse_stamp_ns(format_stamp(stamp_ns)) == stamp_ns
    assert format_stamp(EPOCH_NS) == '1403715273.262142976'
    assert format_stamp(-1) == '-0.000000001'


@pytest.mark.parametrize('text', [
    '', ' ', '.', '-', 'e5', '1e', '1e1_0', '1_000', '--5', '+-5', '1.2.3', '1.-5', '1e5e6', '1 2',
    '0x10', 'nan', 'inf', '1,5', '\u0967', '\u00b2'])
def test_text_that_is_no_decimal_number_is_refused(text):
    with pytest.raises(ValueError):
        parse_stamp_ns(text)


@pytest.mark.parametrize('text', ['1e10', '9223372036.854775808', '-1e99', '1e9999999',
                                  '9' * 5000])
def test_stamps_beyond_64_bits_are_refused(text):
    with pytest.raises(ValueError):
        parse_stamp_ns(text)


# The trajectory


def test_path_length_and_positions():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = [[0, 0, 0], [3, 4, 0], [3, 4, 0], [3, 4, 12]]
    trajectory = Trajectory(np.arange(4), poses)
    assert len(trajectory) == 4
    assert trajectory.path_length == 17.0
    np.testing.assert_array_equal(trajectory.positions[1], [3, 4, 0])
    assert trajectory.select(np.zeros(0, dtype=int)).path_length == 0.0


def test_select_keeps_stamps_poses_and_the_kind_of_measurement():
    trajectory = random_trajectory()
    points = Trajectory(trajectory.stamps_ns, trajectory.poses, has_rotation=False)
    chosen = points.select(np.array([7, 2]))
    np.testing.assert_array_equal(chosen.stamps_ns, trajectory.stamps_ns[[7, 2]])
    np.testing.assert_array_equal(chosen.poses, trajectory.poses[[7, 2]])
    assert not chosen.has_rotation


def test_right_multiplied_gives_the_pose_of_the_mounted_frame():
    trajectory = random_trajectory()
    T_body_camera = geometry.make_transform(geometry.exp_so3([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    camera = trajectory.right_multiplied(T_body_camera)
    origin_in_body = T_body_camera @ [0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(camera.positions, (trajectory.poses @ origin_in_body)[:, :3],
                               atol=1e-12)


# Association


def brute_force(stamps: list[int], reference: list[int], limit: int) -> set[tuple[int, int]]:
    """Return the pairs (stamp index, reference stamp) by the definition of `associate`."""
    best: dict[int, tuple[int, int]] = {}
    for index, stamp in enumerate(stamps):
        nearest = min(reference, key=lambda r: (abs(r - stamp), r))
        distance = abs(nearest - stamp)
        if distance <= limit and distance < best.get(nearest, (limit + 1, 0))[0]:
            best[nearest] = (distance, index)
    return {(index, value) for value, (_, index) in best.items()}


@pytest.mark.parametrize('seed', range(200))
def test_association_is_nearest_one_to_one_and_within_the_limit(seed):
    rng = np.random.default_rng(seed)
    stamps = EPOCH_NS + np.sort(rng.choice(300, rng.integers(1, 30), replace=False))
    reference = EPOCH_NS + rng.choice(300, rng.integers(1, 30), replace=False)
    limit = int(rng.integers(0, 20))
    chosen, nearest = associate(stamps, reference, limit)
    assert (np.diff(chosen) > 0).all()
    assert len(set(nearest)) == len(nearest) == len(chosen)
    assert {(i, reference[j]) for i, j in zip(chosen, nearest)} \
        == brute_force(stamps.tolist(), reference.tolist(), limit)


@pytest.mark.parametrize('stamps, reference, pairs', [
    ([10, 20], [10, 20], [(0, 0), (1, 1)]),
    ([10, 20], [20, 10], [(0, 1), (1, 0)]),
    ([10, 12], [11], [(0, 0)]),
    ([10, 12, 13], [12], [(1, 0)]),
    ([11], [10, 12], [(0, 0)]),
    ([11], [12, 10], [(0, 1)]),
    ([10], [15], [(0, 0)]),
    ([10], [16], []),
    ([10, 10], [10, 10], [(0, 0)]),
    ([], [10], []), ([10], [], []), ([], [], [])],
    ids=['equal', 'unsorted reference', 'tie between stamps', 'the nearer stamp wins',
         'tie between references', 'tie, unsorted', 'at the limit', 'past the limit',
         'repeated stamps', 'no stamps', 'no reference', 'nothing'])
def test_association_by_hand(stamps, reference, pairs):
    chosen, nearest = associate(np.array(stamps, dtype=np.int64),
                                np.array(reference, dtype=np.int64), limit_ns=5)
    assert list(zip(chosen, nearest)) == pairs


def test_association_resolves_single_nanoseconds():
    chosen, nearest = associate(np.array([EPOCH_NS]), EPOCH_NS + np.array([-2, 1, 3]), 1)
    assert (chosen.tolist(), nearest.tolist()) == ([0], [1])


# TUM files


def test_tum_files_survive_the_round_trip(tmp_path):
    trajectory = random_trajectory(200)
    path = tmp_path / 'trajectory.tum'
    path.write_text('# stamp tx ty tz qx qy qz qw\n' + ''.join(
        format_tum_line(stamp, pose)
        for stamp, pose in zip(trajectory.stamps_ns, trajectory.poses)))
    again = read_tum(path)
    assert again.stamps_ns.dtype == np.int64
    np.testing.assert_array_equal(again.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(again.poses, trajectory.poses, rtol=0, atol=3e-9)


def test_a_tum_line_against_known_text():
    T_world_camera = geometry.make_transform(geometry.exp_so3([0.0, 0.0, np.pi]), [1, -2, 0.5])
    assert format_tum_line(EPOCH_NS, T_world_camera).split() == [
        '1403715273.262142976', '1.000000000', '-2.000000000', '0.500000000',
        '0.000000000', '0.000000000', '1.000000000', '0.000000000']


def test_tum_files_may_have_comments_commas_and_blank_lines(tmp_path):
    path = tmp_path / 'groundtruth.txt'
    path.write_text('# comment\n\n1.5 1 2 3 0 0 0 1\n  2.5, 4, 5, 6, 0, 0, 0, -1\r\n')
    trajectory = read_tum(path)
    assert trajectory.stamps_ns.tolist() == [1_500_000_000, 2_500_000_000]
    np.testing.assert_array_equal(trajectory.positions, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(trajectory.poses[:, :3, :3], [np.eye(3)] * 2)
    path.write_text('# nothing else\n')
    assert len(read_tum(path)) == 0


@pytest.mark.parametrize('line', [
    '1 2 3', '1 0 0 0 0 0 0', '1 0 0 0 0 0 0 1 9', 'x 0 0 0 0 0 0 1', '1 0 0 zero 0 0 0 1',
    '1 nan 0 0 0 0 0 1', '1 inf 0 0 0 0 0 1', 'nan 0 0 0 0 0 0 1', '1 0 0 0 0 0 0 0',
    '1 0 0 0 0 0 0 1e-200', '1e20 0 0 0 0 0 0 1', ','])
def test_the_error_names_a_bad_tum_line(tmp_path, line):
    path = tmp_path / 'bad.tum'
    path.write_text(f'# header\n0 0 0 0 0 0 0 1\n{line}\n')
    with pytest.raises(KfvoError, match='bad.tum, line 3: expected "stamp tx ty tz') as caught:
        read_tum(path)
    assert repr(line) in str(caught.value)


# KITTI files


def write_kitti(path, matrices: np.ndarray, decimals: int = 17) -> None:
    np.savetxt(path, matrices[:, :3].reshape(-1, 12), fmt=f'%.{decimals}e')


def test_kitti_poses_are_read(tmp_path):
    trajectory = random_trajectory()
    write_kitti(tmp_path / '03.txt', trajectory.poses)
    again = read_kitti_poses(tmp_path / '03.txt', trajectory.stamps_ns)
    np.testing.assert_allclose(again.poses, trajectory.poses, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(again.stamps_ns, trajectory.stamps_ns)


def test_kitti_rotations_are_orthonormal_despite_few_digits(tmp_path):
    trajectory = random_trajectory()
    write_kitti(tmp_path / '03.txt', trajectory.poses, decimals=6)
    rotations = read_kitti_poses(tmp_path / '03.txt', trajectory.stamps_ns).poses[:, :3, :3]
    np.testing.assert_allclose(rotations, trajectory.poses[:, :3, :3], atol=3e-6)
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), [np.eye(3)] * 20,
                               atol=1e-14)


@pytest.mark.parametrize('line', ['1 2 3', '1 0 0 0 0 1 0 0 0 0 1', '1 0 0 0 0 1 0 0 0 0 1 x',
                                  '1 0 0 0 0 1 0 0 0 0 1 nan', '1 0 0 1e200 0 1 0 0 0 0 1 0'])
def test_a_bad_kitti_line_is_left_out_with_its_stamp(tmp_path, line, caplog):
    path = tmp_path / '03.txt'
    good = '1 0 0 7 0 1 0 0 0 0 1 0'
    path.write_text(f'{good}\n{line}\n{good}\n')
    trajectory = read_kitti_poses(path, np.arange(3))
    assert trajectory.stamps_ns.tolist() == [0, 2]
    np.testing.assert_array_equal(trajectory.positions, [[7, 0, 0]] * 2)
    assert '03.txt: left out 1 rows of 3; line 2: expected "12 numbers"' in caplog.text
    path.write_text(f'{line}\n{line}\n')
    with pytest.raises(KfvoError, match='03.txt, line 1: expected "12 numbers"'):
        read_kitti_poses(path, np.arange(2))


@pytest.mark.parametrize('rotation', [np.zeros((3, 3)), np.diag([1.0, 1.0, -1.0]),
                                      2.0 * np.eye(3)], ids=['zero', 'mirror', 'scaled'])
def test_a_kitti_matrix_that_is_no_rotation_is_left_out(tmp_path, rotation, caplog):
    path = tmp_path / '03.txt'
    write_kitti(path, geometry.make_transform(np.stack([np.eye(3), rotation]), np.zeros((2, 3))))
    assert read_kitti_poses(path, np.arange(2)).stamps_ns.tolist() == [0]
    assert 'left out 1 poses of 2 without a rotation, the first is pose 1' in caplog.text
    write_kitti(path, geometry.make_transform(np.stack([rotation] * 2), np.zeros((2, 3))))
    with pytest.raises(KfvoError, match='03.txt.*rotation'):
        read_kitti_poses(path, np.arange(2))


def test_kitti_poses_must_be_one_per_frame(tmp_path):
    path = tmp_path / '03.txt'
    write_kitti(path, np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(KfvoError, match='holds 3 poses for 2 frames'):
        read_kitti_poses(path, np.arange(2))


@pytest.mark.parametrize('read', [read_tum, lambda path: read_kitti_poses(path, np.arange(2))],
                         ids=['tum', 'kitti'])
def test_the_error_names_an_unreadable_file(tmp_path, read):
    with pytest.raises(KfvoError, match='cannot read .*missing.txt'):
        read(tmp_path / 'missing.txt')
    with pytest.raises(KfvoError, match='cannot read'):
        read(tmp_path)
    (tmp_path / 'image.txt').write_bytes(b'\x89PNG\xff\xfe')
    with pytest.raises(KfvoError, match='cannot read .*image.txt'):
        read(tmp_path / 'image.txt')
