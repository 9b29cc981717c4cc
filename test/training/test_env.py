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
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.training.encoded_sequence import EncodedSequence, encode_sequence
from kfvo_ros.training.env import OBSERVATION, PRIVILEGED, KeyframeEnvironment
from kfvo_ros.training.episode import PRIVILEGED_SIZE, Episode
from kfvo_ros.training.evaluation import Validation
from kfvo_ros.training.rewards import PaperReward, Reward

FRAMES = 30
NO_RAIL = KeyframeGuard(min_survival=0.0, max_gap=10 ** 6, min_flow=0.0)
SIZE = 48 + 7 * 7 + 8
ALL = np.arange(SIZE)


@pytest.fixture(scope='module')
def backbone() -> GeometricBackbone:
    return GeometricBackbone()


@pytest.fixture(scope='module')
def drives(backbone) -> list[EncodedSequence]:
    return [encode_sequence(SyntheticSequence(seed, 'smooth', FRAMES), backbone) for seed in (3, 4)]


def begin(drive: EncodedSequence, backbone: GeometricBackbone, rail: KeyframeGuard = NO_RAIL) -> Episode:
    return Episode(drive, backbone, 'depth', 8, rail, PaperReward())


def again(drive: EncodedSequence, backbone: GeometricBackbone, rail: KeyframeGuard = NO_RAIL) -> Iterator[Episode]:
    return (begin(drive, backbone, rail) for _ in repeat(None))


class Counting(GeometricBackbone):
    """Counts its calls, and the windows in them."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[int] = []

    def estimate(self, windows):
        self.calls.append(len(windows))
        return super().estimate(windows)


class Scripted(KeyframePolicy):
    """Decides as it is told, and remembers what it saw."""

    name = 'scripted'

    def __init__(self, answers) -> None:
        self.answers, self.seen = iter(answers), []

    def decide(self, decision):
        self.seen.append(decision.observation)
        return next(self.answers)


def test_an_environment_sees_what_a_running_policy_sees(backbone, drives):
    answers = np.random.default_rng(0).integers(0, 2, FRAMES).astype(bool)
    policy = Scripted(answers)
    odometry = KeyframeOdometry(backbone, policy, 'depth')
    updates = [odometry.process(frame) for frame in SyntheticSequence(3, 'smooth', FRAMES)]
    assert all(update.status is not Status.LOST for update in updates)

    environment = KeyframeEnvironment(backbone, [again(drives[0], backbone)], ALL)
    seen = [environment.reset()[OBSERVATION][0]]
    for number in range(FRAMES - 8):
        observations, _, dones, _ = environment.step(answers[number:number + 1])
        assert not dones[0]
        seen.append(observations[OBSERVATION][0])
    np.testing.assert_array_equal(seen, policy.seen)


def test_what_is_hidden_is_not_there(backbone, drives):
    source = again(drives[0], backbone)
    everything = KeyframeEnvironment(backbone, [source], ALL).reset()[OBSERVATION][0]
    environment = KeyframeEnvironment(backbone, [source], ALL[48:])
    assert environment.observation_space[OBSERVATION].shape == (SIZE - 48,)
    np.testing.assert_array_equal(environment.reset()[OBSERVATION][0], everything[48:])


def test_two_sequences_take_one_call_per_step(drives):
    backbone = Counting()
    environment = KeyframeEnvironment(
        backbone, [again(drive, backbone) for drive in drives], ALL)
    environment.reset()
    backbone.calls.clear()
    for _ in range(5):
        observations, rewards, dones, _ = environment.step(np.array([1, 0]))
        assert observations[OBSERVATION].shape == (2, SIZE) and rewards.shape == (2,)
        assert observations[PRIVILEGED].shape == (2, PRIVILEGED_SIZE) and not dones.any()
    assert backbone.calls == [2] * 5


def test_the_end_begins_the_next_episode_and_tells_the_last_observation(backbone, drives):
    environment = KeyframeEnvironment(backbone, [again(drives[0], backbone)], ALL)
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


def test_the_critic_is_told_true_motions_in_the_trajectory_s_unit(backbone, drives):
    environment = KeyframeEnvironment(backbone, [again(drives[0], backbone)], ALL)
    told = environment.reset()[PRIVILEGED][0]
    truth = drives[0].T_truth_camera
    true_motions = [geometry.relative(truth[7], truth[6]), geometry.relative(truth[7], truth[8]),
                    geometry.relative(truth[8], truth[9])]
    motions = [geometry.transform_from_xyz_quat(told[at:at + 7].astype(float))
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
    assert told[21] == told[22] == 0.0
    for _ in range(FRAMES - 8):
        observations, *_ = environment.step(np.array([0]))
    end = observations[PRIVILEGED][0]
    assert end[21] == 1.0 and not end[7:21].any() and end[:7].any()


def test_where_the_rail_decides_nobody_is_asked(backbone, drives):
    always = KeyframeGuard(min_survival=0.0, max_gap=3, min_flow=0.0)
    environment = KeyframeEnvironment(backbone, [again(drives[0], backbone, always)], ALL)
    environment.reset()
    asked = 1
    while True:
        _, _, dones, _ = environment.step(np.array([0]))
        if dones[0]:
            break
        asked += 1
    # Of three frames in a row the policy drops two, and the rail keeps the third.
    assert asked == pytest.approx((FRAMES - 7) * 2 / 3, abs=1.0)


def test_lost_and_unanswered_episodes_never_reach_the_rollout(backbone, drives):
    short = EncodedSequence('short', drives[0].frames[:5], drives[0].encoded[:5],
                            drives[0].T_truth_camera[:5])
    sources = iter([begin(short, backbone), begin(short, backbone), begin(drives[1], backbone)])
    environment = KeyframeEnvironment(backbone, [sources], ALL)
    seen = environment.reset()[OBSERVATION][0]
    alone = KeyframeEnvironment(backbone, [again(drives[1], backbone)], ALL)
    np.testing.assert_array_equal(seen, alone.reset()[OBSERVATION][0])


def test_a_lost_camera_ends_the_episode_and_its_frame_is_not_learned_from(drives):
    class Losing(GeometricBackbone):
        """Loses the camera in its eleventh window."""

        windows = 0

        def estimate(self, windows):
            self.windows += len(windows)
            return [replace(found, status=Status.LOST) if self.windows == 11 else found
                    for found in super().estimate(windows)]

    losing = Losing()
    environment = KeyframeEnvironment(losing, [again(drives[0], losing)], ALL)
    seen = [environment.reset()[OBSERVATION][0]]
    ended = []
    for _ in range(6):
        observations, _, dones, infos = environment.step(np.array([1]))
        seen.append(observations[OBSERVATION][0])
        ended.append(bool(dones[0]))
    # Frames 7 to 10 are decided on; the next one is lost, and the sequence begins again.
    assert ended == [False, False, False, True, False, False]
    np.testing.assert_array_equal(seen[4], seen[0])
    assert infos == [{}]


def test_nothing_is_earned_before_the_first_question(backbone, drives):
    class One(Reward):
        def __call__(self, T_world_frame, T_truth_frame, keep):
            return 1.0

    # The gap of any frame is one: until the window is full nobody is asked, then by the rail.
    forcing = KeyframeGuard(min_survival=0.0, max_gap=1, min_flow=0.0)
    episode = Episode(drives[0], backbone, 'depth', 8, forcing, One())
    other = Episode(drives[0], backbone, 'depth', 8, NO_RAIL, One())
    for each in (episode, other):
        while not each.ended and each.decision is None:
            window = each.enter()
            each.leave(backbone.estimate([window])[0] if window is not None else None)
    assert episode.ended and not episode.asked and episode.take_reward() == 0.0
    other.decide(True)
    assert other.asked and other.take_reward() == 1.0


def test_frames_not_seen_before_are_encoded_in_one_call(backbone, drives):
    class Seeing(Counting):
        def encode(self, seen):
            self.calls.append(-len(seen))
            return super().encode(seen)

    seeing = Seeing()
    live = [encode_sequence(SyntheticSequence(seed, 'smooth', FRAMES), None) for seed in (3, 4)]
    environment = KeyframeEnvironment(seeing, [again(drive, seeing) for drive in live], ALL)
    known = KeyframeEnvironment(backbone, [again(drive, backbone) for drive in drives], ALL)
    for each in (environment, known):
        each.reset()
    seeing.calls.clear()
    for _ in range(5):
        seen, recorded = (each.step(np.array([1, 0])) for each in (environment, known))
        np.testing.assert_array_equal(seen[0][OBSERVATION], recorded[0][OBSERVATION])
    assert seeing.calls == [-2, 2] * 5


def test_a_reward_may_ask_for_a_stretch_of_the_trajectory(backbone, drives):
    class Looking(Reward):
        span = 10

        def __init__(self) -> None:
            self.told = []

        def __call__(self, T_world_frame, T_truth_frame, keep):
            self.told.append((T_world_frame, T_truth_frame))
            self.standing = 0.5 * len(self.told)
            return 1.0

    looking = Looking()
    episode = Episode(drives[0], backbone, 'depth', 8, NO_RAIL, looking)
    environment = KeyframeEnvironment(backbone, [iter([episode])], ALL)
    environment.reset()
    for number in range(FRAMES - 8):
        observations, *_ = environment.step(np.array([number % 2]))
    assert observations[PRIVILEGED][0, -1] == looking.standing == 0.5 * (FRAMES - 8)
    estimated, true = looking.told[-1]
    np.testing.assert_array_equal(true, drives[0].T_truth_camera[-11:-1])
    aligned = geometry.umeyama(estimated[:, :3, 3], true[:, :3, 3])
    path = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    assert np.abs(aligned.transform_points(estimated[:, :3, 3]) - true[:, :3, 3]).max() \
        < 0.02 * path
    assert len(looking.told[0][0]) == 8


def test_a_sequence_without_truth_of_the_camera_is_refused(backbone):
    class Blind(SyntheticSequence):
        def ground_truth(self):
            return None

    with pytest.raises(KfvoError, match='expected ground truth of the camera'):
        encode_sequence(Blind(3, 'smooth', 3), backbone)


def test_a_drive_that_never_moves_is_named(backbone, drives):
    still = EncodedSequence('still', drives[0].frames, drives[0].encoded, np.tile(np.eye(4), (FRAMES, 1, 1)))
    validation = Validation([still], backbone, factory.signature_of(OdometryOptions(), backbone))
    with pytest.raises(KfvoError, match='^still: the ground truth never moves'):
        validation.score(EveryFrame())


def test_stable_baselines_learns_in_it(drives):
    from stable_baselines3 import PPO
    backbone = GeometricBackbone()
    environment = KeyframeEnvironment(
        backbone, [again(drive, backbone) for drive in drives], ALL)
    model = PPO('MultiInputPolicy', environment, n_steps=16, batch_size=16, n_epochs=1, seed=0,
                device='cpu')
    before = model.policy.action_net.weight.detach().clone()
    model.learn(32)
    assert (model.policy.action_net.weight != before).any()
