# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""PPO of a keyframe policy, from the first step or a checkpoint to the last step."""

from __future__ import annotations

import math
import warnings
from dataclasses import asdict
from typing import Any, Protocol

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
from kfvo_ros.training.evaluation import PolicyEvaluation, Score
from kfvo_ros.training.imitation import imitate
from kfvo_ros.training.plan import TrainingFiles, TrainingPlan
from kfvo_ros.training.policy_network import PrivilegedCritic, export_actor
from kfvo_ros.utils.config import to_mapping

EPSILON = 1e-8
"""VecNormalize adds it to the variance of observations."""


class TrainingCallback(Protocol):
    """Receives the progress of a training.

    What it raises ends the training between two steps, so the state can be saved.
    """

    def on_step(self, steps: int) -> None:
        """Receive the number of steps so far; 0 while an expert is imitated."""

    def on_rollout(self, mean_return: float, keyframe_rate: float) -> None:
        """Receive the mean return of the latest episodes and the share of kept frames."""

    def on_validation_sequence(self) -> None:
        """Receive that the next validation sequence starts."""

    def on_validation(self, steps: int, score: Score, is_best: bool) -> None:
        """Receive the score of the policy after these steps."""


class Trainer:
    """Trains a policy: `learn` to the end of the plan, `save` after an interruption.

    The best policy by ATE is written when it is found; without `validation` that is the last
    one. `reference_scores` are those of other policies on the validation sequences; `metadata`
    goes into the policy files.
    """

    def __init__(self, plan: TrainingPlan, environment: VecEnv, files: TrainingFiles,
                 validation: PolicyEvaluation | None, reference_scores: dict[str, Score],
                 metadata: dict[str, str], checkpoint: Checkpoint | None = None) -> None:
        self.plan, self._files, self._validation = plan, files, validation
        self._reference_scores, self._metadata = reference_scores, metadata
        self.steps, self._best = 0, math.inf
        if checkpoint is not None:
            self.steps = checkpoint.steps
            if files.output.exists():  # without that file the next policy is the best
                self._best = checkpoint.best
        self._saved_at = self.steps
        self.model = make_model(environment, plan.recipe, plan.seed_at(self.steps))
        if checkpoint is not None:
            checkpoint.restore(self.model)
        self.model.set_logger(Logger(str(files.folder),
                                     [TensorBoardOutputFormat(str(files.folder))]))
        for name, score in reference_scores.items():
            self._log(name, score)

    def learn(self, callback: TrainingCallback) -> None:
        """Train for the steps that are left; errors of the callback pass through."""
        expert, imitation = self.plan.recipe.expert, self.plan.recipe.imitation
        try:
            if expert is not None and imitation is not None and self.steps == 0:
                imitate(self.model, self.plan.signature.observation, expert, imitation,
                        lambda: callback.on_step(0))
            self.model.learn(max(self.plan.recipe.steps - self.steps, 0),
                             _PpoCallback(self, callback), reset_num_timesteps=False)
        finally:
            self.model.logger.close()  # it holds a thread and a file

    def after_update(self, steps: int, is_last: bool, callback: TrainingCallback) -> None:
        """Record that the policy learned from `steps`; validate and save when it is due."""
        self.steps = steps
        if not is_last and steps - self._saved_at < self.plan.recipe.validation_every:
            return
        self._saved_at = steps
        scores = None
        if self._validation is not None:
            policy = self.policy_file().policy(self._validation.signature)
            score = self._validation.score(policy, callback.on_validation_sequence)
            scores = self._reference_scores | {'learned': score}
            is_best = score.ate_percent < self._best
            if is_best:
                self._best = score.ate_percent
                self.policy_file(scores).write(self._files.output)
            self._log('learned', score)
            callback.on_validation(steps, score, is_best)
        self.model.logger.dump(steps)
        self.save(scores)

    def save(self, scores: dict[str, Score] | None = None) -> None:
        """Write the present policy and a checkpoint."""
        last = self.policy_file(scores)
        last.write(self._files.last)
        if self._validation is None and self.steps:
            last.write(self._files.output)
        Checkpoint.of(self.model, self.plan, self.steps, self._best).write(
            self._files.checkpoint)

    def policy_file(self, scores: dict[str, Score] | None = None) -> PolicyFile:
        """Return the present policy, with its validation scores if there are any."""
        policy = self.model.policy
        assert isinstance(policy, PrivilegedCritic)
        plan = to_mapping(self.plan)
        return PolicyFile(
            export_actor(policy, statistics_of(self.model)[OBSERVATION], EPSILON),
            self.plan.recipe.guard or NO_GUARD, self.plan.signature,
            {**self._metadata,
             **{key: plan[key] for key in ('sequences', 'validation', 'seed')},
             'steps': self.steps, **{key: plan[key] for key in ('recipe', 'reading', 'vggt')},
             'scores': {name: asdict(score) for name, score in (scores or {}).items()}})

    def _log(self, policy: str, score: Score) -> None:
        for quantity, value in asdict(score).items():
            self.model.logger.record(f'validation_{quantity}/{policy}', value)


def make_model(environment: VecEnv, recipe: TrainingConfig, seed: int) -> PPO:
    """Return the PPO model on standardised observations and returns of an environment."""
    ppo: dict[str, Any] = asdict(recipe.ppo)
    normalised = VecNormalize(VecMonitor(environment), norm_reward=ppo.pop('normalise_reward'),
                              clip_obs=CLIP, gamma=recipe.ppo.gamma, epsilon=EPSILON)
    rollout = recipe.ppo.n_steps * environment.num_envs
    batch_size = min(ppo.pop('batch_size') or rollout, rollout)
    with warnings.catch_warnings():  # the last batch of a rollout may be smaller
        warnings.filterwarnings('ignore', 'You have specified a mini-batch size')
        model = PPO(PrivilegedCritic, normalised, recipe.learning_rate, batch_size=batch_size,
                    **ppo, seed=seed, device='cpu', policy_kwargs={'width': recipe.width})
    model.set_logger(Logger(None, []))  # the default logger makes a folder in /tmp
    return model


class _PpoCallback(BaseCallback):
    """Passes the events of stable-baselines3 to the trainer and its callback."""

    def __init__(self, trainer: Trainer, callback: TrainingCallback) -> None:
        super().__init__()
        self._trainer, self._callback = trainer, callback

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps > self._trainer.steps:
            self._trainer.after_update(self.model.num_timesteps, False, self._callback)

    def _on_step(self) -> bool:
        self._callback.on_step(self.model.num_timesteps)
        return True

    def _on_rollout_end(self) -> None:
        keyframe_rate = float(self.locals['rollout_buffer'].actions.mean())
        self.logger.record('rollout/keyframe_rate', keyframe_rate)
        episodes = self.model.ep_info_buffer or ()
        self._callback.on_rollout(float(safe_mean([each['r'] for each in episodes])),
                                  keyframe_rate)

    def _on_training_end(self) -> None:
        self._trainer.after_update(self.model.num_timesteps, True, self._callback)
