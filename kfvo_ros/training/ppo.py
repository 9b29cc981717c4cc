# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""PPO of a keyframe policy, from its first step or from a checkpoint to its last step."""

from __future__ import annotations

import math
import warnings
from dataclasses import asdict
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from kfvo_ros.keyframes.guard import NO_GUARD
from kfvo_ros.keyframes.learned import CLIP, PolicyFile
from kfvo_ros.training.checkpoint import Checkpoint, statistics_of
from kfvo_ros.training.config import TrainingConfig
from kfvo_ros.training.env import OBSERVATION
from kfvo_ros.training.evaluation import Score, TrainingCallback, Validation
from kfvo_ros.training.imitation import imitate
from kfvo_ros.training.plan import TrainingFiles, TrainingPlan
from kfvo_ros.training.policy_network import PrivilegedCritic, export_actor

EPSILON = 1e-8
"""Of the standardisation, on the variance."""


class Training:
    """Learns until the plan is fulfilled: `learn`; when that was interrupted, `save`.

    The best policy by ATE is written as soon as it is known; without validation that is the
    last one. `references` were scored on the same drives; `about` goes into the policy files.
    """

    def __init__(self, plan: TrainingPlan, environment: VecEnv, files: TrainingFiles,
                 validation: Validation | None, references: dict[str, Score],
                 about: dict[str, str], checkpoint: Checkpoint | None = None) -> None:
        self.plan, self._files, self._validation = plan, files, validation
        self._references, self._about = references, about
        self.steps, self._best = 0, math.inf
        if checkpoint is not None:
            self.steps = checkpoint.steps
            if files.output.exists():  # else the best from now on, for there is no other
                self._best = checkpoint.best
        self._saved_at = self.steps
        self.model = make_model(environment, plan.recipe, plan.seed_at(self.steps))
        if checkpoint is not None:
            checkpoint.restore(self.model)
        self.model.set_logger(Logger(str(files.folder),
                                     [TensorBoardOutputFormat(str(files.folder))]))
        for name, score in references.items():
            self._log(name, score)

    def learn(self, witness: TrainingCallback) -> None:
        """Go through all steps that are left; raises what the witness does."""
        teacher, imitation = self.plan.recipe.teacher, self.plan.recipe.imitation
        try:
            if teacher is not None and imitation is not None and self.steps == 0:
                imitate(self.model, self.plan.setting.observation, teacher, imitation,
                        lambda: witness.stepped(0))
            self.model.learn(max(self.plan.recipe.steps - self.steps, 0), _Rounds(self, witness),
                             reset_num_timesteps=False)
        finally:
            self.model.logger.close()  # a thread and a file

    def after_update(self, steps: int, is_last: bool, witness: TrainingCallback) -> None:
        """Take note that all `steps` were learned from; validate and save when it is time."""
        self.steps = steps
        if not is_last and steps - self._saved_at < self.plan.recipe.validation_every:
            return
        self._saved_at = steps
        scores = None
        if self._validation is not None:
            policy = self.policy_file().policy(self._validation.setting)
            score = self._validation.score(policy, witness.validating)
            scores = self._references | {'learned': score}
            is_best = score.ate_percent < self._best
            if is_best:
                self._best = score.ate_percent
                self.policy_file(scores).write(self._files.output)
            self._log('learned', score)
            witness.validated(steps, score, is_best)
        self.model.logger.dump(steps)
        self.save(scores)

    def save(self, scores: dict[str, Score] | None = None) -> None:
        """Write the policy as it is now, and a checkpoint to go on from."""
        last = self.policy_file(scores)
        last.write(self._files.last)
        if self._validation is None and self.steps:
            last.write(self._files.output)
        Checkpoint.of(self.model, self.plan, self.steps, self._best).write(
            self._files.checkpoint)

    def policy_file(self, scores: dict[str, Score] | None = None) -> PolicyFile:
        """Return the policy as it is now, with the scores in its validation if it had one."""
        policy = self.model.policy
        assert isinstance(policy, PrivilegedCritic)
        plan = self.plan
        return PolicyFile(
            export_actor(policy, statistics_of(self.model)[OBSERVATION], EPSILON),
            plan.recipe.rail or NO_GUARD, plan.setting,
            {**self._about, 'sequences': plan.sequences, 'validation': plan.validation,
             'seed': plan.seed, 'steps': self.steps, 'recipe': asdict(plan.recipe),
             'reading': asdict(plan.reading), 'vggt': plan.vggt and asdict(plan.vggt),
             'scores': {name: asdict(score) for name, score in (scores or {}).items()}})

    def _log(self, name: str, score: Score) -> None:
        for what, value in asdict(score).items():
            self.model.logger.record(f'validation_{what}/{name}', value)


def make_model(environment: VecEnv, recipe: TrainingConfig, seed: int) -> PPO:
    """Return the learner of an environment, of its returns and standardised observations."""
    ppo: dict[str, Any] = asdict(recipe.ppo)
    normalised = VecNormalize(VecMonitor(environment), norm_reward=ppo.pop('normalise_reward'),
                              clip_obs=CLIP, gamma=recipe.ppo.gamma, epsilon=EPSILON)
    rollout = recipe.ppo.n_steps * environment.num_envs
    batch_size = min(ppo.pop('batch_size') or rollout, rollout)
    with warnings.catch_warnings():  # one batch of a rollout may be smaller
        warnings.filterwarnings('ignore', 'You have specified a mini-batch size')
        model = PPO(PrivilegedCritic, normalised, recipe.learning_rate.at, batch_size=batch_size,
                    **ppo, seed=seed, device='cpu', policy_kwargs={'width': recipe.width})
    model.set_logger(Logger(None, []))  # without one it would make a folder in /tmp
    return model


class _Rounds(BaseCallback):
    """Brings what happens in PPO to the training and its witness."""

    def __init__(self, training: Training, witness: TrainingCallback) -> None:
        super().__init__()
        self._training, self._witness = training, witness

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps > self._training.steps:
            self._training.after_update(self.model.num_timesteps, False, self._witness)

    def _on_step(self) -> bool:
        self._witness.stepped(self.model.num_timesteps)
        return True

    def _on_rollout_end(self) -> None:
        keyframe_rate = float(self.locals['rollout_buffer'].actions.mean())
        self.logger.record('rollout/keyframe_rate', keyframe_rate)
        episodes = self.model.ep_info_buffer or ()
        self._witness.collected(float(safe_mean([each['r'] for each in episodes])),
                                keyframe_rate)

    def _on_training_end(self) -> None:
        self._training.after_update(self.model.num_timesteps, True, self._witness)
