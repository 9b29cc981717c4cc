# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt over the poses and hosted inverse depths of one window."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric import kernels

HUBER = 0.8
"""Reprojection errors beyond it count linearly [px]."""
FIRST_DAMPING, LEAST_DAMPING = 1e-4, 1e-7
DAMPING_DOWN, DAMPING_UP = 0.2, 8.0
MAX_REJECTIONS = 5
"""Steps that may fail in a row before the estimate is taken for a minimum."""
MIN_IMPROVEMENT = 1e-3
"""A step that lowers the cost by a smaller share is the last one."""
LEAST_INVERSE_DEPTH = 1e-4
TINY = 1e-9


@dataclass(frozen=True)
class Problem:
    """What is measured in a window of F frames and P points; arrays as in `kernels`.

    The first ``fixed`` frames are not moved. A point's inverse depth r is drawn to
    ``prior_values`` (P,) with ``prior_weights`` (P,) [px^2 per unit squared].
    """

    hosts: np.ndarray
    rays: np.ndarray
    seen: np.ndarray
    mask: np.ndarray
    focal: float
    fixed: int
    prior_weights: np.ndarray
    prior_values: np.ndarray

    def observed(self, mask: np.ndarray) -> Problem:
        """Return the problem with fewer observations."""
        return replace(self, mask=mask)


@dataclass(frozen=True)
class State:
    """Where the frames and points are: ``rotations``, ``translations``, ``inverse_depths``."""

    rotations: np.ndarray
    translations: np.ndarray
    inverse_depths: np.ndarray

    def stepped(self, pose_step: np.ndarray, depth_step: np.ndarray) -> State:
        """Apply a step (6 (F - fixed),) of the last frames and (P,)."""
        step = pose_step.reshape(-1, 6)
        rotations, translations = self.rotations.copy(), self.translations.copy()
        fixed = len(rotations) - len(step)
        rotations[fixed:] = rotations[fixed:] @ geometry.exp_so3(step[:, :3])
        translations[fixed:] += step[:, 3:]
        return State(rotations, translations,
                     np.maximum(self.inverse_depths + depth_step, LEAST_INVERSE_DEPTH))

    def scaled(self, factor: float) -> State:
        """Return the same window in another unit."""
        return State(self.rotations, self.translations * factor, self.inverse_depths / factor)


@dataclass(frozen=True)
class NormalEquations:
    """Second-order picture of the cost, depths apart from poses; blocks as in `kernels`."""

    H_cc: np.ndarray
    g_c: np.ndarray
    H_pc: np.ndarray
    H_pp: np.ndarray
    g_p: np.ndarray

    def reduce(self, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Eliminate the depths (Schur complement); return system and gradient of the poses."""
        eliminated = self.H_pc / (self.H_pp * (1.0 + damping) + TINY)[:, None]
        system = self.H_cc - self.H_pc.T @ eliminated
        system[np.diag_indices(len(system))] += damping * self.H_cc.diagonal() + TINY
        return system, self.g_c - eliminated.T @ self.g_p

    def step(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the damped Gauss-Newton step of free poses (C,) and inverse depths (P,)."""
        system, gradient = self.reduce(damping)
        poses = -np.linalg.solve(system, gradient)
        depths = -(self.g_p + self.H_pc @ poses) / (self.H_pp * (1.0 + damping) + TINY)
        return poses, depths


def reprojection_errors(problem: Problem, state: State) -> np.ndarray:
    """Return errors (P, F) [px], 0 where nothing is measured."""
    return kernels.reprojection_errors(
        state.rotations, state.translations, state.inverse_depths, problem.hosts, problem.rays,
        problem.seen, problem.mask, problem.focal)


def cost(problem: Problem, state: State) -> float:
    """Return the Huber cost [px^2] of observations and priors."""
    errors = reprojection_errors(problem, state)
    quadratic = np.minimum(errors, HUBER)
    away = state.inverse_depths - problem.prior_values
    return float(np.vdot(quadratic, 2.0 * errors - quadratic)
                 + problem.prior_weights @ (away * away))


def linearise(problem: Problem, state: State) -> NormalEquations:
    """Return the normal equations at `state`, priors included."""
    H_cc, g_c, H_pc, H_pp, g_p = kernels.linearise(
        state.rotations, state.translations, state.inverse_depths, problem.hosts, problem.rays,
        problem.seen, problem.mask, problem.focal, HUBER, problem.fixed)
    pull = problem.prior_weights * (state.inverse_depths - problem.prior_values)
    return NormalEquations(H_cc, g_c, H_pc, H_pp + problem.prior_weights, g_p + pull)


def adjust(problem: Problem, state: State, iterations: int) -> State:
    """Return the state of least cost near `state`, in at most so many accepted steps."""
    damping = FIRST_DAMPING
    current = cost(problem, state)
    for _ in range(iterations):
        normal = linearise(problem, state)
        for _ in range(MAX_REJECTIONS):
            candidate = state.stepped(*normal.step(damping))
            candidate_cost = cost(problem, candidate)
            if candidate_cost < current:
                break
            damping *= DAMPING_UP
        else:
            return state
        improvement = 1.0 - candidate_cost / current
        state, current = candidate, candidate_cost
        damping = max(damping * DAMPING_DOWN, LEAST_DAMPING)
        if improvement < MIN_IMPROVEMENT:
            break
    return state
