# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rotations, rigid transforms and similarities as plain float64 arrays.

``T_a_b`` (4, 4) maps points of frame b into frame a: ``x_a = T_a_b @ x_b``. Quaternions are
``quat_xyzw``, unit norm, ``qw >= 0``. Every function accepts leading batch axes unless it says
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def make_transform(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Build T (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    rotation = np.asarray(rotation, dtype=np.float64)
    transform = np.zeros(rotation.shape[:-2] + (4, 4))
    transform[..., :3, :3] = rotation
    transform[..., :3, 3] = translation
    transform[..., 3, 3] = 1.0
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
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    generator = skew(vector)
    return np.eye(3) + first * generator + second * (generator @ generator)


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
    # Twice the sine and the cosine: the one is exact where the other loses digits.
    return np.arctan2(np.sqrt(x * x + y * y + z * z),
                      r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2] - 1.0)


def quat_xyzw_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return unit quaternions (..., 4), qw >= 0, of rotations (..., 3, 3).

    The largest of the four candidates is taken, so no angle loses digits (Shepperd 1978).
    """
    r = np.asarray(rotation, dtype=np.float64)
    candidates = (r.reshape(-1, 9) @ _SLOPES + _OFFSET).reshape(-1, 4, 4)
    largest = candidates.diagonal(axis1=1, axis2=2).argmax(axis=1)
    quaternion = candidates[np.arange(len(candidates)), largest]
    length = np.sqrt((quaternion * quaternion).sum(axis=1, keepdims=True))
    return (quaternion / np.copysign(length, quaternion[:, 3:])).reshape(*r.shape[:-2], 4)


def _quaternions(r: np.ndarray) -> np.ndarray:
    """Return four multiples (4, 4) of a rotation's quaternion, by x, y, z and w: 4 q q^T."""
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] + r[1, 2]
    (a, _, _), (_, b, _), (_, _, c) = r
    return np.array([[1.0 + a - b - c, xy, xz, x], [xy, 1.0 - a + b - c, yz, y],
                     [xz, yz, 1.0 - a - b + c, z], [x, y, z, 1.0 + a + b + c]])


# They are linear in the rotation, so one product makes those of many.
_OFFSET = _quaternions(np.zeros((3, 3))).ravel()
_SLOPES = np.array([_quaternions(unit.reshape(3, 3)).ravel() - _OFFSET for unit in np.eye(9)])


def rotation_from_quat_xyzw(quat_xyzw: np.ndarray) -> np.ndarray:
    """Return rotations (..., 3, 3) of quaternions (..., 4); the norm is divided out."""
    quaternion = np.asarray(quat_xyzw, dtype=np.float64)
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    vector, scalar = quaternion[..., :3], quaternion[..., 3, None, None]
    generator = skew(vector)
    return np.eye(3) + 2.0 * scalar * generator + 2.0 * (generator @ generator)


def transform_from_xyz_quat(values: np.ndarray) -> np.ndarray:
    """Return T (..., 4, 4) of ``x y z qx qy qz qw`` (..., 7), as text and messages hold poses."""
    return make_transform(rotation_from_quat_xyzw(values[..., 3:]), values[..., :3])


def orthonormalise(transform: np.ndarray) -> np.ndarray:
    """Return T (..., 4, 4) with an exact rotation; products of many drift away from one."""
    quat_xyzw = quat_xyzw_from_rotation(transform[..., :3, :3])
    return make_transform(rotation_from_quat_xyzw(quat_xyzw), transform[..., :3, 3])


def best_rotation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that turns vectors `source` (N, 3) closest to `target` (N, 3).

    Source: Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976.
    """
    return nearest_rotation(target.T @ source)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotations (..., 3, 3) R of largest trace(R^T M) to matrices M (..., 3, 3)."""
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

    Coincident source points determine a translation and nothing else. Source: Umeyama,
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
