# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Observation of the keyframe policies: content, layout and indices of its parts."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.keyframes.base import indices_of, layout_of, observe


def test_observation_content():
    rng = np.random.default_rng(0)
    T_w_frame = geometry.make_transform(geometry.exp_so3(1.5 * rng.normal(size=(8, 3))),
                                        5.0 * rng.normal(size=(8, 3)))
    descriptors = [rng.normal(size=48).astype(np.float32) for _ in range(8)]
    signals = np.arange(6, dtype=np.float32)
    observation = observe(descriptors, T_w_frame, signals)
    assert observation.shape == (48 + 7 * 7 + 6,)
    assert observation.dtype == np.float32
    np.testing.assert_allclose(observation[:48], np.mean(descriptors, axis=0), atol=1e-6)
    assert np.array_equal(observation[-6:], signals)
    poses = observation[48:-6].reshape(7, 7)
    for T_w_keyframe, row in zip(T_w_frame[:7], poses):  # oldest first
        T_newest_keyframe = np.linalg.inv(T_w_frame[-1]) @ T_w_keyframe
        np.testing.assert_allclose(row[:3], T_newest_keyframe[:3, 3], atol=1e-4)
        np.testing.assert_allclose(geometry.rotation_from_quat_xyzw(row[3:]),
                                   T_newest_keyframe[:3, :3], atol=1e-5)
    assert (poses[:, 6] >= 0.0).all()
    assert (geometry.log_so3(T_w_frame[:7, :3, :3]) != 0.0).any()


def test_observation_does_not_depend_on_the_world():
    rng = np.random.default_rng(1)
    poses = geometry.make_transform(geometry.exp_so3(rng.normal(size=(9, 3))),
                                    rng.normal(size=(9, 3)))
    descriptors, signals = [np.ones(4, dtype=np.float32)] * 8, np.zeros(0, dtype=np.float32)
    first = observe(descriptors, poses[:8], signals)
    second = observe(descriptors, poses[8] @ poses[:8], signals)
    np.testing.assert_allclose(first, second, atol=1e-5)
    assert first.shape == (4 + 49,)


def test_layout_describes_the_observation():
    layout = layout_of(48, 8, ('near', 'far'))
    assert layout == (('descriptor', 48), ('poses', 49), ('near', 1), ('far', 1))
    observation = observe([np.zeros(48, np.float32)] * 8, np.tile(np.eye(4), (8, 1, 1)),
                          np.zeros(2, np.float32))
    assert sum(size for _, size in layout) == len(observation)


def test_indices_select_parts_in_their_order():
    layout = layout_of(48, 8, ('near', 'far'))
    indices = indices_of((('far', 1), ('descriptor', 48)), layout)
    assert indices.tolist() == [98, *range(48)]
    with pytest.raises(KeyError):
        indices_of((('descriptor', 1024),), layout)
