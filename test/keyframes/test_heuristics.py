# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe policies by rule, and what a learned one will see."""

from __future__ import annotations

import numpy as np
import pytest
from odometry_scenes import sure

from kfvo_ros import geometry
from kfvo_ros.keyframes import POLICIES
from kfvo_ros.keyframes.base import DecisionInput, observe
from kfvo_ros.keyframes.heuristics import MIN_TRACKS, EveryFrame, OpticalFlow, Survival
from kfvo_ros.keyframes.learned import Learned

COUNT = 100


def decision(flow: float = 0.0, survivors: int = COUNT, start: int = COUNT) -> DecisionInput:
    """Return a decision where `survivors` of the keyframe's tracks moved by `flow` [px]."""
    rng = np.random.default_rng(0)
    keyframe = sure(np.arange(start), rng.uniform(0.0, 500.0, (start, 2)))
    angles = rng.uniform(0.0, 2.0 * np.pi, survivors)
    shift = flow * np.column_stack([np.cos(angles), np.sin(angles)])
    new = rng.uniform(0.0, 500.0, (50, 2))
    newest = sure(np.concatenate([np.arange(survivors), 1000 + np.arange(50)]),
                  np.concatenate([keyframe.pixels[:survivors] + shift, new]))
    return DecisionInput(np.zeros(1, dtype=np.float32), keyframe, newest, 1)


def test_names():
    assert tuple(kind.name for kind in (EveryFrame, OpticalFlow, Survival, Learned)) == POLICIES


def test_every_keeps_without_tracks():
    assert EveryFrame().decide(DecisionInput(np.zeros(1), None, None, 1)) is True
    assert not EveryFrame.needs_tracks
    assert OpticalFlow.needs_tracks
    assert Survival.needs_tracks


@pytest.mark.parametrize(('threshold', 'flow', 'keep'), [
    (50.0, 49.9, False), (50.0, 50.1, True), (50.0, 0.0, False), (20.0, 20.1, True),
    (20.0, 19.9, False)])
def test_optical_flow_compares_the_mean_flow(threshold, flow, keep):
    assert OpticalFlow(threshold).decide(decision(flow)) == keep


def test_optical_flow_default_is_that_of_the_paper():
    assert OpticalFlow().threshold == 50.0
    assert (Survival().share, Survival().min_flow) == (0.8, 2.0)


@pytest.mark.parametrize(('share', 'survivors', 'keep'), [
    (0.8, 80, False), (0.8, 79, True), (0.8, 100, False), (0.8, 20, True),
    (0.5, 51, False), (0.5, 49, True)])
def test_survival_counts_the_keyframes_tracks(share, survivors, keep):
    assert Survival(share).decide(decision(10.0, survivors)) == keep


@pytest.mark.parametrize(('flow', 'keep'), [(0.0, False), (1.9, False), (2.1, True)])
def test_survival_never_keeps_a_camera_at_rest(flow, keep):
    assert Survival().decide(decision(flow, survivors=30)) == keep


@pytest.mark.parametrize('policy', [OpticalFlow(), Survival()])
def test_few_tracks_left_keep(policy):
    assert policy.decide(decision(0.0, MIN_TRACKS - 1)) is True
    assert policy.decide(decision(0.0, 0)) is True
    assert policy.decide(decision(0.0, 0, start=0)) is True
    assert not policy.decide(decision(0.0, MIN_TRACKS))


def test_observation_layout():
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
    for keyframe, row in zip(T_w_frame[:7], poses):  # oldest first
        T_newest_keyframe = np.linalg.inv(T_w_frame[-1]) @ keyframe
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
    one = observe(descriptors, poses[:8], signals)
    other = observe(descriptors, poses[8] @ poses[:8], signals)
    np.testing.assert_allclose(one, other, atol=1e-5)
    assert one.shape == (4 + 49,)
