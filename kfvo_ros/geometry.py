# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rotations, rigid transforms and similarities as plain float64 arrays.

``T_a_b`` (4, 4) maps points of frame b into frame a: ``x_a = T_a_b @ x_b``. Quaternions are
``quat_xyzw``, unit norm, ``qw >= 0``. Functions accept leading batch axes unless their shapes
say otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros.errors import KfvoError


def make_transform(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Build T (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    rotation = np.asarray(rotation, dtype=np.float64)
    transform = np.zeros(rotation.shape[:-2] + (4, 4))
    transform[..., :3, :3] = rotation
    transform[..., :3, 3] = translation
    transform[..., 3, 3] = 1.0
    return transform


def as_rigid_transform(numbers: object, source: str) -> np.ndarray:
    """Return T (4, 4) of 16 numbers in row-major order.

    Raises KfvoError that begins with `source` when the numbers are no rigid transform.
    """
    try:
        transform = np.array(numbers, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        transform = np.zeros((4, 4))
    rotation = transform[:3, :3]
    if not (np.isfinite(transform).all() and np.allclose(transform[3], (0, 0, 0, 1))
            and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
            and np.linalg.det(rotation) > 0):
        found = ' '.join(str(numbers).split())
        raise KfvoError(f'{source}: expected a rigid 4x4 transform (a rotation, a translation, '
                        f'and 0 0 0 1 below), found {found[:200]}')
    return transform


def invert(transform: np.ndarray) -> np.ndarray:
    """Return T_b_a (..., 4, 4) of rigid T_a_b (..., 4, 4)."""
    rotation = np.swapaxes(transform[..., :3, :3], -1, -2)
    return make_transform(rotation, -(rotation @ transform[..., :3, 3:])[..., 0])


def relative(T_w_a: np.ndarray, T_w_b: np.ndarray) -> np.ndarray:
    """Return T_a_b = T_w_a^-1 T_w_b, both (..., 4, 4)."""
    return invert(T_w_a) @ T_w_b


def skew(vector: np.ndarray) -> np.ndarray:
    """Return [v]x (..., 3, 3), so that [v]x u = v x u."""
    vector = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*vector.shape, 3))
    for axis, (row, column) in enumerate(((2, 1), (0, 2), (1, 0))):
        matrix[..., row, column] = vector[..., axis]
        matrix[..., column, row] = -vector[..., axis]
    return matrix


def exp_so3(rotation_vector: np.ndarray) -> np.ndarray:
    """Return the rotation (..., 3, 3) of a rotation vector (..., 3) [rad]."""
    vector = np.asarray(rotation_vector, dtype=np.float64)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    # np.sinc keeps both coefficients smooth through zero: sin(a)/a and (1 - cos(a))/a^2.
    linear = np.sinc(angle / np.pi)
    quadratic = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    generator = skew(vector)
    return np.eye(3) + linear * generator + quadratic * (generator @ generator)


def log_so3(rotation: np.ndarray) -> np.ndarray:
    """Return the rotation vector (..., 3) [rad], norm in [0, pi], of rotations (..., 3, 3)."""
    quaternion = quat_xyzw_from_rotation(rotation)
    sine = np.linalg.norm(quaternion[..., :3], axis=-1, keepdims=True)
    half_angle = np.arctan2(sine, quaternion[..., 3:])
    tiny = sine < 1e-12
    return quaternion[..., :3] * np.where(tiny, 2.0, 2.0 * half_angle / np.where(tiny, 1.0, sine))


def rotation_angle(rotation: np.ndarray) -> np.ndarray:
    """Return the angle (...,) [rad], in [0, pi], of rotations (..., 3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    x, y, z = (r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0],
               r[..., 1, 0] - r[..., 0, 1])
    # Twice the sine and twice the cosine: each is precise where the other loses digits.
    return np.arctan2(np.sqrt(x * x + y * y + z * z),
                      r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2] - 1.0)


def quat_xyzw_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return unit quaternions (..., 4), qw >= 0, of rotations (..., 3, 3).

    The longest of four candidates is normalised, so no angle loses digits (Shepperd 1978).
    """
    r = np.asarray(rotation, dtype=np.float64)
    candidates = (r.reshape(-1, 9) @ _CANDIDATE_SLOPES + _CANDIDATE_OFFSET).reshape(-1, 4, 4)
    longest = candidates.diagonal(axis1=1, axis2=2).argmax(axis=1)
    quaternion = candidates[np.arange(len(candidates)), longest]
    norm = np.sqrt((quaternion * quaternion).sum(axis=1, keepdims=True))
    return (quaternion / np.copysign(norm, quaternion[:, 3:])).reshape(*r.shape[:-2], 4)


def _quaternion_candidates(r: np.ndarray) -> np.ndarray:
    """Return 4 q q^T (4, 4) of a rotation (3, 3): its rows are q times x, y, z and w."""
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] + r[1, 2]
    (a, _, _), (_, b, _), (_, _, c) = r
    return np.array([[1.0 + a - b - c, xy, xz, x], [xy, 1.0 - a + b - c, yz, y],
                     [xz, yz, 1.0 - a - b + c, z], [x, y, z, 1.0 + a + b + c]])


# The candidates are linear in the rotation, so one matrix product serves a whole batch.
_CANDIDATE_OFFSET = _quaternion_candidates(np.zeros((3, 3))).ravel()
_CANDIDATE_SLOPES = np.array([_quaternion_candidates(unit.reshape(3, 3)).ravel()
                              - _CANDIDATE_OFFSET for unit in np.eye(9)])


def rotation_from_quat_xyzw(quat_xyzw: np.ndarray) -> np.ndarray:
    """Return rotations (..., 3, 3) of quaternions (..., 4), which need no unit norm."""
    quaternion = np.asarray(quat_xyzw, dtype=np.float64)
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    vector, scalar = quaternion[..., :3], quaternion[..., 3, None, None]
    generator = skew(vector)
    return np.eye(3) + 2.0 * scalar * generator + 2.0 * (generator @ generator)


def transform_from_xyz_quat(values: np.ndarray) -> np.ndarray:
    """Return T (..., 4, 4) of ``x y z qx qy qz qw`` (..., 7), the order of files and messages."""
    return make_transform(rotation_from_quat_xyzw(values[..., 3:]), values[..., :3])


def orthonormalise(transform: np.ndarray) -> np.ndarray:
    """Return T (..., 4, 4) with its rotation made orthonormal.

    Odometry feeds poses back through `invert`, which transposes the rotation. A departure from
    orthonormality therefore grows two- to threefold per frame unless it is removed each time.
    """
    quat_xyzw = quat_xyzw_from_rotation(transform[..., :3, :3])
    return make_transform(rotation_from_quat_xyzw(quat_xyzw), transform[..., :3, 3])


def best_rotation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that maps vectors `source` (N, 3) closest to `target` (N, 3).

    Source: Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976.
    """
    return nearest_rotation(target.T @ source)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotations R (..., 3, 3) that maximise trace(R^T M) of matrices M (..., 3, 3)."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


@dataclass(frozen=True)
class Similarity:
    """x_target = scale * rotation @ x_source + translation."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def transform_points(self, points: np.ndarray) -> np.ndarray:
        """Map points (N, 3)."""
        return self.scale * points @ self.rotation.T + self.translation

    def transform_poses(self, poses: np.ndarray) -> np.ndarray:
        """Map T_source_x (N, 4, 4) to T_target_x; rotations stay rotations."""
        return make_transform(self.rotation @ poses[:, :3, :3],
                              self.transform_points(poses[:, :3, 3]))


def umeyama(source: np.ndarray, target: np.ndarray, with_scale: bool = True) -> Similarity:
    """Return the least-squares similarity from source to target points, both (N, 3), N >= 1.

    Coincident source points give a translation only: scale 1 and no rotation. Source: Umeyama,
    "Least-squares estimation of transformation parameters between two point patterns", PAMI
    1991.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    if not np.ptp(source, axis=0).any():
        return Similarity(1.0, np.eye(3), mean_target - mean_source)
    centred_source, centred_target = source - mean_source, target - mean_target
    variance = np.sum(centred_source ** 2) / len(source)
    u, singular, vt = np.linalg.svd(centred_target.T @ centred_source / len(source))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float(singular @ sign / variance) if with_scale and variance > 0.0 else 1.0
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)
