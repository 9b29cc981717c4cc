# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe selection as an environment of stable-baselines3, on rendered sequences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice, repeat

import numpy as np
import pytest

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Status
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import KeyframePolicy
from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.keyframes.heuristics import EveryFrame
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.training.encoded_sequence import EncodedSequence, encode_sequence
from kfvo_ros.training.env import OBSERVATION, PRIVILEGED, KeyframeEnvironment
from kfvo_ros.training.episode import PRIVILEGED_SIZE, Episode, _metres_per_unit
from kfvo_ros.training.rewards import PaperReward, Reward

FRAMES = 30
NO_GUARD = KeyframeGuard(min_survival=0.0, max_gap=10 ** 6, min_flow=0.0)
SIZE = 48 + 7 * 7 + 8
ALL = np.arange(SIZE)


@pytest.fixture(scope='module')
def backbone() -> GeometricBackbone:
    return GeometricBackbone()


@pytest.fixture(scope='module')
def sequences(backbone) -> list[EncodedSequence]:
    return [encode_sequence(SyntheticSequence(seed, 'smooth', FRAMES), backbone)
            for seed in (3, 4)]


def make_episode(sequence: EncodedSequence, backbone: GeometricBackbone,
                 guard: KeyframeGuard = NO_GUARD) -> Episode:
    return Episode(sequence, backbone, 'depth', 8, guard, PaperReward())


def episodes(sequence: EncodedSequence, backbone: GeometricBackbone,
             guard: KeyframeGuard = NO_GUARD) -> Iterator[Episode]:
    """Yield the same episode without end."""
    return (make_episode(sequence, backbone, guard) for _ in repeat(None))


class CallRecordingBackbone(GeometricBackbone):
    """Records the number of windows of each call."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[int] = []

    def estimate(self, windows):
        self.calls.append(len(windows))
        return super().estimate(windows)


class RecordingPolicy(KeyframePolicy):
    """Decides by a list, and records the observations."""

    name = 'scripted'

    def __init__(self, decisions) -> None:
        self.decisions, self.observations = iter(decisions), []

    def decide(self, decision):
        self.observations.append(decision.observation)
        return next(self.decisions)


def test_observations_are_those_of_a_policy_in_use(backbone, sequences):
    decisions = np.random.default_rng(0).integers(0, 2, FRAMES).astype(bool)
    policy = RecordingPolicy(decisions)
    odometry = KeyframeOdometry(backbone, policy, 'depth')
    updates = [odometry.process(frame) for frame in SyntheticSequence(3, 'smooth', FRAMES)]
    assert all(update.status is not Status.LOST for update in updates)

    environment = KeyframeEnvironment(backbone, [episodes(sequences[0], backbone)], ALL)
    seen = [environment.reset()[OBSERVATION][0]]
    for number in range(FRAMES - 8):
        observations, _, dones, _ = environment.step(decisions[number:number + 1])
        assert not dones[0]
        seen.append(observations[OBSERVATION][0])
    np.testing.assert_array_equal(seen, policy.observations)


def test_observations_hold_the_selected_numbers_only(backbone, sequences):
    source = episodes(sequences[0], backbone)
    everything = KeyframeEnvironment(backbone, [source], ALL).reset()[OBSERVATION][0]
    environment = KeyframeEnvironment(backbone, [source], ALL[48:])
    assert environment.observation_space[OBSERVATION].shape == (SIZE - 48,)
    np.testing.assert_array_equal(environment.reset()[OBSERVATION][0], everything[48:])


def test_two_sequences_take_one_call_per_step(sequences):
    backbone = CallRecordingBackbone()
    environment = KeyframeEnvironment(
        backbone, [episodes(sequence, backbone) for sequence in sequences], ALL)
    environment.reset()
    backbone.calls.clear()
    for _ in range(5):
        observations, rewards, dones, _ = environment.step(np.array([1, 0]))
        assert observations[OBSERVATION].shape == (2, SIZE) and rewards.shape == (2,)
        assert observations[PRIVILEGED].shape == (2, PRIVILEGED_SIZE) and not dones.any()
    assert backbone.calls == [2] * 5


def test_the_next_episode_follows_and_the_last_observation_is_terminal(backbone, sequences):
    environment = KeyframeEnvironment(backbone, [episodes(sequences[0], backbone)], ALL)
    first = environment.reset()[OBSERVATION][0]
    decisions = FRAMES - 7
    for _ in range(decisions - 1):
        last, _, dones, infos = environment.step(np.array([1]))
        assert not dones[0] and not infos[0]
    observations, rewards, dones, infos = environment.step(np.array([1]))
    assert dones[0] and rewards[0] != 0.0 and infos[0]['TimeLimit.truncated']
    np.testing.assert_array_equal(observations[OBSERVATION][0], first)
    np.testing.assert_array_equal(infos[0]['terminal_observation'][OBSERVATION],
                                  last[OBSERVATION][0])


def test_privileged_observations_are_true_motions_in_trajectory_units(backbone, sequences):
    environment = KeyframeEnvironment(backbone, [episodes(sequences[0], backbone)], ALL)
    privileged = environment.reset()[PRIVILEGED][0]
    truth = sequences[0].T_truth_camera
    true_motions = [geometry.relative(truth[7], truth[6]), geometry.relative(truth[7], truth[8]),
                    geometry.relative(truth[8], truth[9])]
    motions = [geometry.transform_from_xyz_quat(privileged[at:at + 7].astype(float))
               for at in (0, 7, 14)]
    scales = [np.linalg.norm(true[:3, 3]) / np.linalg.norm(motion[:3, 3])
              for true, motion in zip(true_motions, motions)]
    assert np.ptp(scales) < 1e-4 * scales[0]  # metres per unit of the trajectory
    odometry = KeyframeOdometry(backbone, EveryFrame())
    for frame in islice(SyntheticSequence(3, 'smooth', FRAMES), 8):
        odometry.process(frame)
    estimated = np.array([frame.T_world_camera[:3, 3] for frame in odometry.window[:7]])
    expected = geometry.umeyama(estimated, truth[1:8, :3, 3]).scale
    assert scales[0] == pytest.approx(expected, rel=0.01)
    for true, motion in zip(true_motions, motions):
        np.testing.assert_allclose(motion[:3, :3], true[:3, :3], atol=1e-6)
    assert privileged[21] == privileged[22] == 0.0
    for _ in range(FRAMES - 8):
        observations, *_ = environment.step(np.array([0]))
    end = observations[PRIVILEGED][0]
    assert end[21] == 1.0 and not end[7:21].any() and end[:7].any()


@pytest.mark.parametrize(('spread_m', 'expected'), [(0.0099, 1.0), (0.0101, 0.0404)])
def test_below_a_spread_of_1_cm_a_unit_counts_as_a_metre(spread_m, expected):
    positions = np.outer([-0.5, 0.5], [0.6, 0.0, 0.8]) * np.sqrt(2.0)  # with a spread of 1
    true = spread_m * positions
    assert _metres_per_unit(0.25 * positions, true) == pytest.approx(expected)
    assert _metres_per_unit(np.zeros((2, 3)), true) == 1.0


def test_forced_decisions_are_not_steps(backbone, sequences):
    guard = KeyframeGuard(min_survival=0.0, max_gap=3, min_flow=0.0)
    environment = KeyframeEnvironment(backbone, [episodes(sequences[0], backbone, guard)], ALL)
    environment.reset()
    steps = 1
    while True:
        _, _, dones, _ = environment.step(np.array([0]))
        if dones[0]:
            break
        steps += 1
    # Of three frames in a row the policy drops two, and the guard keeps the third.
    assert steps == pytest.approx((FRAMES - 7) * 2 / 3, abs=1.0)


def test_episodes_without_a_decision_are_skipped(backbone, sequences):
    short = EncodedSequence('short', sequences[0].frames[:5], sequences[0].encoded[:5],
                            sequences[0].T_truth_camera[:5])
    source = (make_episode(each, backbone) for each in (short, short, sequences[1]))
    environment = KeyframeEnvironment(backbone, [source], ALL)
    seen = environment.reset()[OBSERVATION][0]
    alone = KeyframeEnvironment(backbone, [episodes(sequences[1], backbone)], ALL)
    np.testing.assert_array_equal(seen, alone.reset()[OBSERVATION][0])


def test_a_lost_camera_ends_the_episode_without_a_decision(sequences):
    class LosingBackbone(GeometricBackbone):
        """Loses the camera in its eleventh window."""

        windows = 0

        def estimate(self, windows):
            self.windows += len(windows)
            return [replace(found, status=Status.LOST) if self.windows == 11 else found
                    for found in super().estimate(windows)]

    losing = LosingBackbone()
    environment = KeyframeEnvironment(losing, [episodes(sequences[0], losing)], ALL)
    seen = [environment.reset()[OBSERVATION][0]]
    ended = []
    for _ in range(6):
        observations, _, dones, infos = environment.step(np.array([1]))
        seen.append(observations[OBSERVATION][0])
        ended.append(bool(dones[0]))
    # Frames 7 to 10 are decisions; the next frame is lost, and the sequence starts again.
    assert ended == [False, False, False, True, False, False]
    np.testing.assert_array_equal(seen[4], seen[0])
    assert infos == [{}]


def test_rewards_before_the_first_decision_do_not_count(backbone, sequences):
    class ConstantReward(Reward):
        def __call__(self, T_world_frame, T_truth_frame, keep):
            return 1.0

    # The gap of any frame is one: with a full window every decision is forced.
    forcing = KeyframeGuard(min_survival=0.0, max_gap=1, min_flow=0.0)
    forced = Episode(sequences[0], backbone, 'depth', 8, forcing, ConstantReward())
    free = Episode(sequences[0], backbone, 'depth', 8, NO_GUARD, ConstantReward())
    for each in (forced, free):
        while not each.ended and each.decision is None:
            window = each.begin()
            each.integrate(backbone.estimate([window])[0] if window is not None else None)
    assert forced.ended and not forced.reached_decision and forced.pop_reward() == 0.0
    free.decide(True)
    assert free.reached_decision and free.pop_reward() == 1.0 and free.pop_reward() == 0.0


def test_frames_of_many_sequences_are_encoded_in_one_call(backbone, sequences):
    class EncodingBackbone(CallRecordingBackbone):
        def encode(self, seen):
            self.calls.append(-len(seen))
            return super().encode(seen)

    encoding = EncodingBackbone()
    images = [encode_sequence(SyntheticSequence(seed, 'smooth', FRAMES), None) for seed in (3, 4)]
    environment = KeyframeEnvironment(encoding, [episodes(each, encoding) for each in images], ALL)
    encoded = KeyframeEnvironment(backbone, [episodes(each, backbone) for each in sequences], ALL)
    for each in (environment, encoded):
        each.reset()
    encoding.calls.clear()
    for _ in range(5):
        found, expected = (each.step(np.array([1, 0])) for each in (environment, encoded))
        np.testing.assert_array_equal(found[0][OBSERVATION], expected[0][OBSERVATION])
    assert encoding.calls == [-2, 2] * 5


def test_a_reward_with_a_span_gets_the_latest_frames(backbone, sequences):
    class RecordingReward(Reward):
        span = 10

        def __init__(self) -> None:
            self.calls = []

        def __call__(self, T_world_frame, T_truth_frame, keep):
            self.calls.append((T_world_frame, T_truth_frame))
            self.quality = 0.5 * len(self.calls)
            return 1.0

    reward = RecordingReward()
    episode = Episode(sequences[0], backbone, 'depth', 8, NO_GUARD, reward)
    environment = KeyframeEnvironment(backbone, [iter([episode])], ALL)
    environment.reset()
    for number in range(FRAMES - 8):
        observations, *_ = environment.step(np.array([number % 2]))
    assert observations[PRIVILEGED][0, -1] == reward.quality == 0.5 * (FRAMES - 8)
    estimated, true = reward.calls[-1]
    np.testing.assert_array_equal(true, sequences[0].T_truth_camera[-11:-1])
    aligned = geometry.umeyama(estimated[:, :3, 3], true[:, :3, 3])
    path = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    assert np.abs(aligned.transform_points(estimated[:, :3, 3]) - true[:, :3, 3]).max() \
        < 0.02 * path
    assert len(reward.calls[0][0]) == 8


def test_a_sequence_without_truth_of_the_camera_is_refused(backbone):
    class WithoutTruth(SyntheticSequence):
        def ground_truth(self):
            return None

    with pytest.raises(KfvoError, match='expected ground truth of the camera'):
        encode_sequence(WithoutTruth(3, 'smooth', 3), backbone)


def test_stable_baselines_learns_in_it(sequences):
    from stable_baselines3 import PPO
    backbone = GeometricBackbone()
    environment = KeyframeEnvironment(
        backbone, [episodes(sequence, backbone) for sequence in sequences], ALL)
    model = PPO('MultiInputPolicy', environment, n_steps=16, batch_size=16, n_epochs=1, seed=0,
                device='cpu')
    before = model.policy.action_net.weight.detach().clone()
    model.learn(32)
    assert (model.policy.action_net.weight != before).any()
