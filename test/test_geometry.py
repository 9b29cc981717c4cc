# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rotations, rigid transforms and similarities, against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.geometry import Similarity, umeyama

ANGLES = [0.0, 1e-300, 1e-16, 1e-9, 1e-6, 1e-3, 0.5, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-6,
          np.pi - 1e-9]


def random_axes(count: int, seed: int = 0) -> np.ndarray:
    axes = np.random.default_rng(seed).normal(size=(count, 3))
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def random_rotations(count: int, seed: int = 0) -> np.ndarray:
    return geometry.rotation_from_quat_xyzw(np.random.default_rng(seed).normal(size=(count, 4)))


def random_poses(count: int, seed: int = 0) -> np.ndarray:
    translations = np.random.default_rng(seed + 1).normal(size=(count, 3))
    return geometry.make_transform(random_rotations(count, seed), translations)


def assert_rotations(rotation: np.ndarray) -> None:
    identity = np.broadcast_to(np.eye(3), rotation.shape)
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, -1, -2), identity, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-14)


def test_skew_is_the_cross_product():
    v, u = random_axes(2)
    np.testing.assert_allclose(geometry.skew(v) @ u, np.cross(v, u), atol=1e-15)


def test_exp_rotates_right_handed_about_the_axis():
    quarter = geometry.exp_so3([0.0, 0.0, np.pi / 2])
    np.testing.assert_allclose(quarter @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


def test_exp_is_the_matrix_exponential():
    vectors = random_axes(20) * np.linspace(0.0, 3.0, 20)[:, None]
    term, series = np.eye(3), np.broadcast_to(np.eye(3), (20, 3, 3)).copy()
    for order in range(1, 40):
        term = term @ geometry.skew(vectors) / order
        series += term
    np.testing.assert_allclose(geometry.exp_so3(vectors), series, atol=1e-13)


@pytest.mark.parametrize('angle', ANGLES)
def test_log_inverts_exp(angle):
    vectors = random_axes(200) * angle
    rotation = geometry.exp_so3(vectors)
    assert_rotations(rotation)
    np.testing.assert_allclose(geometry.log_so3(rotation), vectors, rtol=0, atol=1e-12)
    np.testing.assert_allclose(geometry.rotation_angle(rotation), angle, rtol=0, atol=1e-12)


def test_small_rotations_keep_their_relative_precision():
    vectors = random_axes(50) * 1e-8
    np.testing.assert_allclose(geometry.log_so3(geometry.exp_so3(vectors)), vectors, rtol=1e-7)


def test_half_turns_have_angle_pi_and_either_axis():
    axes = np.concatenate([np.eye(3), random_axes(100)])
    rotation = 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    vectors = geometry.log_so3(rotation)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), np.pi, atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(vectors * axes, axis=1)), np.pi, atol=1e-12)


@pytest.mark.parametrize('angle', ANGLES)
def test_quaternions_invert_and_have_a_positive_scalar(angle):
    rotation = geometry.exp_so3(random_axes(200) * angle)
    quaternion = geometry.quat_xyzw_from_rotation(rotation)
    assert (quaternion[:, 3] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(geometry.rotation_from_quat_xyzw(quaternion), rotation,
                               atol=1e-14)


def test_quaternion_order_sign_and_norm():
    half = np.sqrt(0.5)
    quarter_about_x = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(geometry.quat_xyzw_from_rotation(quarter_about_x),
                               [half, 0.0, 0.0, half], atol=1e-15)
    for factor in (1.0, -1.0, 7.0):
        np.testing.assert_allclose(
            geometry.rotation_from_quat_xyzw(factor * np.array([half, 0.0, 0.0, half])),
            quarter_about_x, atol=1e-15)


def test_batches_of_any_shape_agree_with_single_calls():
    rotation = random_rotations(6).reshape(2, 3, 3, 3)
    for function in (geometry.log_so3, geometry.quat_xyzw_from_rotation,
                     geometry.rotation_angle):
        batch = function(rotation)
        assert batch.shape[:2] == (2, 3)
        np.testing.assert_array_equal(batch[1, 2], function(rotation[1, 2]))
    poses = random_poses(6).reshape(2, 3, 4, 4)
    np.testing.assert_array_equal(geometry.invert(poses)[1, 2], geometry.invert(poses[1, 2]))


def test_invert_and_relative():
    T_w_a, T_w_b = random_poses(10), random_poses(10, seed=5)
    np.testing.assert_allclose(geometry.invert(T_w_a), np.linalg.inv(T_w_a), atol=1e-13)
    T_a_b = geometry.relative(T_w_a, T_w_b)
    np.testing.assert_allclose(T_w_a @ T_a_b, T_w_b, atol=1e-13)


def test_as_rigid_transform_reads_rows_and_refuses_the_rest():
    pose = random_poses(1)[0]
    np.testing.assert_array_equal(geometry.as_rigid_transform(pose.ravel().tolist(), 'T'), pose)
    for numbers in (None, 'x', [1.0] * 15, 2.0 * pose, pose.T, np.full((4, 4), np.nan)):
        with pytest.raises(KfvoError, match='^sensor.yaml: expected a rigid 4x4 transform'):
            geometry.as_rigid_transform(numbers, 'sensor.yaml')


def test_orthonormalise_removes_small_errors_only():
    poses = random_poses(50)
    noisy = poses.copy()
    noisy[:, :3, :3] += np.random.default_rng(1).normal(scale=1e-7, size=(50, 3, 3))
    result = geometry.orthonormalise(noisy)
    assert_rotations(result[:, :3, :3])
    np.testing.assert_allclose(result, poses, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(result[:, :3, 3], poses[:, :3, 3])
    np.testing.assert_allclose(geometry.orthonormalise(poses), poses, rtol=0, atol=1e-15)


def test_similarity_transforms_poses_like_points():
    similarity = Similarity(2.5, random_rotations(1)[0], np.array([1.0, -2.0, 3.0]))
    poses = random_poses(10)
    transformed = similarity.transform_poses(poses)
    assert_rotations(transformed[:, :3, :3])
    x = np.array([0.3, -0.7, 1.1])
    in_source = (poses @ np.append(x, 1.0))[:, :3]
    in_target = (transformed @ np.append(2.5 * x, 1.0))[:, :3]
    np.testing.assert_allclose(similarity.transform_points(in_source), in_target, atol=1e-13)


@pytest.mark.parametrize('count', [3, 4, 100])
@pytest.mark.parametrize('scale', [1e-3, 1.0, 40.0])
def test_umeyama_recovers_a_similarity(count, scale):
    truth = Similarity(scale, random_rotations(1, seed=count)[0], np.array([5.0, -6.0, 700.0]))
    source = np.random.default_rng(count).normal(size=(count, 3))
    found = umeyama(source, truth.transform_points(source))
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-9 * (1 + scale))


def test_umeyama_without_scale_keeps_scale_one():
    source = np.random.default_rng(3).normal(size=(50, 3))
    rotation = random_rotations(1)[0]
    found = umeyama(source, 3.0 * source @ rotation.T, with_scale=False)
    assert found.scale == 1.0
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)


def test_umeyama_minimises_the_squared_distance():
    rng = np.random.default_rng(4)
    source, target = rng.normal(size=(2, 30, 3))

    def cost(s: Similarity) -> float:
        return float(np.sum((s.transform_points(source) - target) ** 2))

    best = umeyama(source, target)
    for _ in range(200):
        factor, rotation_vector, shift = 1 + 1e-3 * rng.normal(), *(
            1e-3 * rng.normal(size=(2, 3)))
        assert cost(best) <= cost(Similarity(best.scale * factor,
                                             geometry.exp_so3(rotation_vector) @ best.rotation,
                                             best.translation + shift))


def test_umeyama_never_returns_a_reflection():
    source = np.random.default_rng(5).normal(size=(40, 3))
    mirrored = source * [1.0, 1.0, -1.0]
    for target in (mirrored, mirrored @ random_rotations(1)[0].T):
        found = umeyama(source, target)
        assert_rotations(found.rotation)
        assert 0.0 < found.scale < 1.0


@pytest.mark.parametrize('spread', [[1.0, 1.0, 0.0], [1.0, 0.0, 0.0]], ids=['plane', 'line'])
def test_umeyama_is_exact_for_coplanar_and_collinear_points(spread):
    source = np.random.default_rng(6).normal(size=(20, 3)) * spread
    truth = Similarity(0.3, random_rotations(1, seed=8)[0], np.array([1.0, 2.0, 3.0]))
    found = umeyama(source, truth.transform_points(source))
    assert_rotations(found.rotation)
    assert found.scale == pytest.approx(0.3)
    np.testing.assert_allclose(found.transform_points(source), truth.transform_points(source),
                               atol=1e-14)


@pytest.mark.parametrize('point', [[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]])
@pytest.mark.parametrize('count', [1, 7])
def test_umeyama_of_coincident_points_is_a_translation(point, count):
    target = np.random.default_rng(7).normal(size=(count, 3))
    found = umeyama(np.tile(point, (count, 1)), target)
    assert found.scale == 1.0
    np.testing.assert_array_equal(found.rotation, np.eye(3))
    np.testing.assert_allclose(found.transform_points(np.array([point])),
                               [target.mean(axis=0)], atol=1e-15)
