# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One window from tracks to poses: first guess, bundle adjustment, outliers, covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Points, WindowPrior
from kfvo_ros.backbones.geometric import bundle_adjustment as ba
from kfvo_ros.backbones.geometric import numba_utils, reprojection, triangulation
from kfvo_ros.backbones.geometric.initialisation import Guess, Initialiser
from kfvo_ros.backbones.geometric.keyframe_history import HistoryFrames, history_of
from kfvo_ros.backbones.geometric.observations import TrackTable
from kfvo_ros.backbones.geometric.reprojection import Problem, State
from kfvo_ros.backbones.geometric.schur import depth_information, reduce

ITERATIONS, FINAL_ITERATIONS = 3, 4
WIDE = 1.0
"""Width of the loss at first [px]: a rough start is pulled from afar."""
NARROW = 1.7
"""... and in the end, times the noise: a track that slides a little, as along the rim of something
near, should hardly pull."""
MAX_NOISE, MAX_ERROR = 4.5, (2.0, 5.0)
"""Tracks farther off anywhere after the first adjustment are outliers: so many times the noise,
within bounds [px], for where nothing fits noise has none."""
TRUSTED_DEPTH_PRIOR = 1.0
"""How strongly a point whose depth was measured holds its last [px^2 for one wrong by 100 %].

It keeps the scale through rotation and hovering, where nothing is measured."""
DEPTH_PRIOR = 0.05
"""The same for others: of what rotation brought into view the depth is but supposed, and hundreds
that hold on to it would outweigh the motion after it."""
LEAST_PRIOR_SPREAD = 0.2
"""The same for points so far away that 100 % of their inverse depth is nothing: this share of
the median's."""
SUSPICIOUS_SHARE = 0.5
"""When fewer of the newest frame's tracks fit, its first place may have been wrong."""
WELL_KNOWN = 0.1
"""A depth whose standard deviation is no larger a share of it is worth to be held on to."""
LEAST_INFORMATION = 1e-12
"""So much is known of every direction, as a share of the best known: where it is all, the
covariance is large."""
LEAST_NOISE = 0.1
"""Tracks are never believed to be better than this [px]."""
LEAST_FREEDOM = 0.25
"""A window fits two views of a point exactly in one direction of two."""


@dataclass(frozen=True)
class Solution:
    """A solved window; frame ``anchor`` is identity, those before it are its history.

    The mask of ``problem`` (F, P) is what is left of the observations.
    """

    observations: TrackTable
    anchor: int
    problem: Problem
    state: State

    @property
    def solved(self) -> np.ndarray:
        """Mask (P,) of the points whose tracks are left."""
        return np.asarray(self.problem.mask.any(axis=0))

    @cached_property
    def T_anchor_frame(self) -> np.ndarray:
        """Poses (F, 4, 4) of all frames, exactly identity for the anchor."""
        poses = geometry.make_transform(self.state.rotations, self.state.translations)
        poses[self.anchor] = np.eye(4)
        return poses

    @property
    def measured(self) -> bool:
        """Whether depths are measured well enough to be held on to."""
        return self.median_information > self._enough

    @property
    def well_known(self) -> np.ndarray:
        """Mask (N,) of the points whose own depths are."""
        return self.points.information > self._enough

    @property
    def _enough(self) -> float:
        """Information on a depth that is well known from tracks as noisy as these."""
        return (self.noise / WELL_KNOWN) ** 2

    @cached_property
    def median_information(self) -> float:
        """Median information of the points' depths, 0 without points."""
        return numba_utils.median(self.points.information) if len(self.points.ids) else 0.0

    @cached_property
    def median_depth(self) -> float:
        """Median distance of the points from the anchor, 1 without points."""
        return numba_utils.median(self.points.depths) if len(self.points.ids) else 1.0

    @cached_property
    def noise(self) -> float:
        """How far the tracks that are left are off [px]."""
        return _noise(self.problem, reprojection.errors(self.problem, self.state))

    @cached_property
    def points(self) -> Points:
        """Return the solved points; a depth's information is that given the poses."""
        rows = np.flatnonzero(self.solved)
        given_poses = self.problem._replace(fixed=len(self.problem.mask))
        information = depth_information(ba.linearise(given_poses, self.state, False, np.float64))
        x, y, r = (part[rows] for part in self.state.points)
        origins = self.problem.origins
        positions = triangulation.point_positions(origins[:, :3, :3].copy(), origins[:, :3, 3].copy(),
                                                  self.problem.hosts[rows],
                                                  np.stack([x, y, np.ones(len(rows))], axis=1), r)
        return Points(self.observations.ids[rows], positions, information[rows] * r ** 2)

    def covariance(self) -> np.ndarray:
        """Return covariances (S, 6, 6) from the anchor on, in it, translation first.

        It contains how well the window's scale is tied to the past, by history and depth
        priors: where points have no parallax it grows, which reprojection errors do not show.
        """
        system, _ = reduce(ba.linearise(self.problem, self.state, False, np.float64))
        free = len(system) // 6
        blocks = self.noise ** 2 * _inverse(system).reshape(free, 6, free, 6)
        turns = np.zeros((free, 6, 6))
        turns[:, :3, 3:] = turns[:, 3:, :3] = self.state.rotations[self.anchor + 1:]
        covariance = np.zeros((free + 1, 6, 6))
        own = np.arange(free)
        covariance[1:] = turns @ blocks[own, :, own] @ np.swapaxes(turns, 1, 2)
        return 0.5 * (covariance + np.swapaxes(covariance, 1, 2))


def solve(observations: TrackTable, initialiser: Initialiser, previous: WindowPrior | None,
          history: HistoryFrames) -> Solution:
    """Place the frames of a window in the anchor, in the unit of `previous`, else median depth 1.

    A draft moves the newest frame alone: the others hardly change. But what the last window found
    may be a wrong minimum. While little is known, a start from nothing competes with it; where
    the window is doubted, one from its history; and these drafts move all frames.
    """
    anchor, certain = len(history.views), history_of(previous).certain
    settled = certain and not history.doubted
    fixed = observations.mask.shape[1] - 1 if settled else anchor + 1
    draft = partial(_draft, observations, initialiser.focal, fixed)
    drafts = []
    if previous is not None and previous.points is not None:
        drafts.append(draft(initialiser.from_previous(observations, previous, history)))
        if drafts[0].newest_inlier_share < SUSPICIOUS_SHARE:
            drafts.append(draft(initialiser.from_previous(observations, previous, history, True)))
        if history.doubted:
            drafts.append(draft(initialiser.from_history(observations, previous, history)))
    if not certain:
        pair = initialiser.best_pair(observations)
        if pair is not None or not drafts:
            drafts.append(draft(initialiser.from_nothing(observations, pair)))
    return _finish(observations, min(drafts, key=lambda each: each.cost), anchor)


@dataclass(frozen=True)
class _Draft:
    """A window adjusted with all its observations, of which ``inliers`` (F, P) fit."""

    problem: Problem
    state: State
    inliers: np.ndarray
    noise: float
    cost: float

    @property
    def newest_inlier_share(self) -> float:
        """Share of the newest frame's observations that fit."""
        return float(self.inliers[-1].sum()) / max(1, self.problem.mask[-1].sum())


def _draft(observations: TrackTable, focal: float, fixed: int, guess: Guess) -> _Draft:
    """Adjust from a guess and tell the outliers: a track that is wrong once has slid before."""
    problem = _problem(observations, focal, guess, fixed)
    state = ba.adjust(problem, guess.state, ITERATIONS)
    errors = reprojection.errors(problem, state)
    noise = _noise(problem, errors)
    largest = errors.max(axis=0) / problem.certainty
    fits = largest <= np.clip(MAX_NOISE * noise, *MAX_ERROR)
    return _Draft(problem, state, problem.mask & fits, noise, reprojection.cost(problem, state))


def _finish(observations: TrackTable, draft: _Draft, anchor: int) -> Solution:
    """Adjust again without the outliers, narrowly."""
    problem = draft.problem._replace(mask=draft.inliers, width=NARROW * draft.noise,
                                     fixed=anchor + 1)
    state = ba.adjust(problem, draft.state, FINAL_ITERATIONS)
    return Solution(observations, anchor, problem, state)


def _noise(problem: Problem, errors: np.ndarray) -> float:
    """Return the median of errors (F, P), had they not been fitted; 1 without any [px]."""
    typical, count = numba_utils.median_where(errors, problem.mask)
    if not count:
        return 1.0
    fitted = 3 * problem.mask.any(axis=0).sum() + 6 * (len(problem.mask) - problem.fixed)
    left = max(1.0 - fitted / (2 * count), LEAST_FREEDOM)
    return max(LEAST_NOISE, typical / math.sqrt(left))


def _problem(observations: TrackTable, focal: float, guess: Guess, fixed: int) -> Problem:
    """Return the bundle adjustment of a window, depths drawn to where they are expected."""
    expected = guess.expected_inverse_depths
    strength = np.where(guess.trusted, TRUSTED_DEPTH_PRIOR, DEPTH_PRIOR)
    spread = np.maximum(expected, LEAST_PRIOR_SPREAD * numba_utils.median(expected))
    origins = geometry.make_transform(guess.state.rotations, guess.state.translations)
    return Problem(observations.hosts, origins,
                   np.ascontiguousarray(observations.seen.transpose(1, 2, 0)),
                   np.ascontiguousarray(observations.mask.T),
                   focal, fixed, observations.certainty, strength / spread ** 2, expected, WIDE)


def _inverse(system: np.ndarray) -> np.ndarray:
    """Return the inverse of a symmetric system, large in directions that nothing determines."""
    least = LEAST_INFORMATION * system.diagonal().max()
    return np.linalg.inv(system + least * np.eye(len(system)))
