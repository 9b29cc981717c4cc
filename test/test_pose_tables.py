# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of measured poses as recorders and people write them."""

from __future__ import annotations

import time

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.trajectory import parse_nanoseconds, parse_stamp_ns, read_pose_table

T0 = 1403715273
POSE = '1 2 3 0 0 0 1'


def read(tmp_path, *lines: str, **options):
    path = tmp_path / 'groundtruth.txt'
    path.write_text('\n'.join(lines))
    return read_pose_table(path, options.pop('parse', parse_stamp_ns), **options)


@pytest.mark.parametrize('bad', [
    f'{T0} nan nan nan nan nan nan nan', f'{T0} 1 2 3 0 0 0 0', f'{T0} 1 2 3 0 0 0', f'{T0}',
    f'{T0} 1e200 2 3 0 0 0 1', f'{T0} 1 2 inf 0 0 0 1', f'1e30 {POSE}', f'{10 ** 30} {POSE}',
    'timestamp,tx,ty,tz,qx,qy,qz,qw', f'{T0} 1 2 3 0 0 0 x', ';;', f'{T0} 1 2 3 0 0 0 1e-9'])
def test_a_row_without_a_pose_is_left_out(bad, tmp_path, caplog):
    trajectory = read(tmp_path, f'{T0}.5 {POSE}', bad, f'{T0 + 1}.25 {POSE}')
    assert trajectory.stamps_ns.tolist() == [T0 * 10 ** 9 + 500_000_000,
                                             (T0 + 1) * 10 ** 9 + 250_000_000]
    np.testing.assert_array_equal(trajectory.positions, [[1, 2, 3]] * 2)
    assert 'groundtruth.txt: left out 1 rows of 3; line 2: expected "stamp x y z' in caplog.text
    with pytest.raises(KfvoError, match='groundtruth.txt, line 1: expected "stamp x y z'):
        read(tmp_path, bad, bad)


def test_good_rows_leave_no_warning(tmp_path, caplog):
    commas = POSE.replace(' ', ', ')
    assert len(read(tmp_path, '# stamp', f'1.5 {POSE}', '', f'2.5, {commas}')) == 2
    assert len(read(tmp_path, '# nothing')) == 0
    assert not caplog.records


def test_positions_only(tmp_path, caplog):
    trajectory = read(tmp_path, f'{T0} 1 2 3', f'{T0}.1 4 5 6')
    assert not trajectory.has_rotation and not caplog.records
    np.testing.assert_array_equal(trajectory.positions, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(trajectory.poses[:, :3, :3], [np.eye(3)] * 2)
    mixed = read(tmp_path, f'{T0} {POSE}', f'{T0}.1 4 5 6', f'{T0}.2 {POSE}')
    assert mixed.has_rotation and len(mixed) == 2
    assert 'left out 1 rows of 3' in caplog.text


@pytest.mark.parametrize('first', [0, 1])
@pytest.mark.parametrize('pose', [POSE, '1 2 3'])
def test_a_column_of_row_numbers_is_skipped(pose, first, tmp_path):
    trajectory = read(tmp_path, 'row,stamp,x,y,z', *(
        f'{first + index},{T0 + index}.5,{pose.replace(" ", ",")}' for index in range(5)))
    assert trajectory.stamps_ns.tolist() == [(T0 + index) * 10 ** 9 + 500_000_000
                                             for index in range(5)]
    np.testing.assert_array_equal(trajectory.positions, [[1, 2, 3]] * 5)


def test_stamps_from_zero_are_no_row_numbers(tmp_path):
    trajectory = read(tmp_path, *(f'{index} {POSE}' for index in range(4)))
    assert trajectory.stamps_ns.tolist() == [index * 10 ** 9 for index in range(4)]


@pytest.mark.parametrize(('text', 'expected'), [
    ('1403715273262142976', 1403715273262142976), ('1.403715273262142976e+18',
                                                  1403715273262142976),
    ('1403715273262142976.0', 1403715273262142976)])
def test_nanoseconds_with_exponents_are_exact(text, expected, tmp_path):
    """EuRoC: the quaternion begins with its scalar, and more columns follow."""
    trajectory = read(tmp_path, f'{text}, 1, 2, 3, 0.8, 0.6, 0, 0, 9, 9, 9', scalar_first=True,
                      parse=parse_nanoseconds)
    assert trajectory.stamps_ns.tolist() == [expected]
    np.testing.assert_allclose(trajectory.poses[0, :3, :3], geometry.rotation_from_quat_xyzw(
        np.array([0.6, 0, 0, 0.8])), atol=1e-15)


def test_long_tables_are_read_fast(tmp_path):
    path = tmp_path / 'groundtruth.txt'
    path.write_text(''.join(f'{T0 + index}.123456789 {POSE}\n' for index in range(100_000)))
    start = time.process_time()
    assert len(read_pose_table(path, parse_stamp_ns)) == 100_000
    assert time.process_time() - start < 3.0  # a million in less than 10 s takes 1 s
