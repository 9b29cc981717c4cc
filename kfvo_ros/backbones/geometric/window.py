# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Solve one window: competing initial guesses, bundle adjustment, outliers, covariance."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Points, WindowPrior
from kfvo_ros.backbones.geometric import bundle_adjustment as ba
from kfvo_ros.backbones.geometric import numba_utils, reprojection, triangulation
from kfvo_ros.backbones.geometric.initialisation import InitialGuess, Initialiser
from kfvo_ros.backbones.geometric.keyframe_history import HistoryFrames, history_of
from kfvo_ros.backbones.geometric.observations import TrackTable
from kfvo_ros.backbones.geometric.reprojection import Problem, State
from kfvo_ros.backbones.geometric.schur import depth_information, marginalise_points

ITERATIONS, FINAL_ITERATIONS = 3, 4
INITIAL_WIDTH = 1.0
"""Width of the loss at first [px]: wide for a rough start ..."""
FINAL_WIDTH = 1.7
"""... and in the end, times the noise: tracks that slide slightly, as along the outline of a near
object, get little weight."""
MAX_NOISE_RATIO, MAX_ERROR_BOUNDS = 4.5, (2.0, 5.0)
"""Tracks with a larger error in any frame are outliers: a multiple of the noise, within bounds
[px] because the noise has no bound where nothing fits."""
TRUSTED_DEPTH_PRIOR = 1.0
"""Weight of the prior on a depth that was measured well [px^2 for an error of 100 %].

It keeps the scale through rotation and hovering, where no depth is measured."""
DEPTH_PRIOR = 0.05
"""Weight for other depths: those of points that rotation brought into view are only assumed, and
hundreds of them must not outweigh the motion that follows."""
MIN_PRIOR_SPREAD = 0.2
"""Least inverse depth that priors are relative to, as a share of the median: for far points 100 %
of their own is nearly nothing."""
MIN_INLIER_SHARE = 0.5
"""Below this share of inliers in the newest frame, its initial pose may have been wrong."""
WELL_MEASURED_SIGMA = 0.1
"""Largest relative standard deviation of a depth that was measured well."""
MIN_INFORMATION = 1e-12
"""Information on unobserved directions, as a share of the best observed one."""
MIN_NOISE = 0.1
"""Least noise of tracks [px]."""
MIN_FREEDOM = 0.25
"""Least share of degrees of freedom; two observations of a point leave one of four."""


@dataclass(frozen=True)
class Solution:
    """A solved window; frame ``anchor`` is the identity, those before it are its history.

    The mask of ``problem`` (F, P) marks the inliers of ``table``.
    """

    table: TrackTable
    anchor: int
    problem: Problem
    state: State

    @property
    def solved(self) -> np.ndarray:
        """Mask (P,) of the points with inliers."""
        return np.asarray(self.problem.mask.any(axis=0))

    @cached_property
    def T_anchor_frame(self) -> np.ndarray:
        """Poses (F, 4, 4) of all frames, exactly identity for the anchor."""
        poses = geometry.make_transform(self.state.rotations, self.state.translations)
        poses[self.anchor] = np.eye(4)
        return poses

    @property
    def measured(self) -> bool:
        """Whether the median depth is measured well."""
        return self.median_information > self._sufficient_information

    @property
    def well_measured(self) -> np.ndarray:
        """Mask (N,) of the solved points whose own depth is measured well."""
        return self.points.information > self._sufficient_information

    @property
    def _sufficient_information(self) -> float:
        """Information, for 1 px noise, on a depth that is measured well despite the noise."""
        return (self.noise / WELL_MEASURED_SIGMA) ** 2

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
        """Noise of the inliers [px]."""
        return _noise(self.problem, reprojection.errors(self.problem, self.state))

    @cached_property
    def points(self) -> Points:
        """Return the solved points; the information on their depths is given the poses."""
        rows = np.flatnonzero(self.solved)
        given_poses = self.problem._replace(fixed=len(self.problem.mask))
        information = depth_information(ba.linearise(given_poses, self.state, False, np.float64))
        x, y, r = (part[rows] for part in self.state.points)
        origins = self.problem.origins
        positions = triangulation.point_positions(
            origins[:, :3, :3].copy(), origins[:, :3, 3].copy(), self.problem.hosts[rows],
            np.stack([x, y, np.ones(len(rows))], axis=1), r)
        return Points(self.table.ids[rows], positions, information[rows] * r ** 2)

    def covariance(self) -> np.ndarray:
        """Return covariances (S, 6, 6) from the anchor on, in it, translation first.

        They include the uncertainty of the window's scale, which history and depth priors tie to
        the past: it grows without parallax, while reprojection errors stay small.
        """
        system, _ = marginalise_points(
            ba.linearise(self.problem, self.state, False, np.float64))
        free = len(system) // 6
        blocks = self.noise ** 2 * _regularised_inverse(system).reshape(free, 6, free, 6)
        to_anchor = np.zeros((free, 6, 6))
        to_anchor[:, :3, 3:] = to_anchor[:, 3:, :3] = self.state.rotations[self.anchor + 1:]
        covariance = np.zeros((free + 1, 6, 6))
        own = np.arange(free)
        covariance[1:] = to_anchor @ blocks[own, :, own] @ np.swapaxes(to_anchor, 1, 2)
        return 0.5 * (covariance + np.swapaxes(covariance, 1, 2))


def solve(table: TrackTable, initialiser: Initialiser, prior: WindowPrior | None,
          history: HistoryFrames) -> Solution:
    """Return the window's poses in the anchor, in the unit of `prior` or else the median depth.

    Candidates are adjusted from different initial guesses and the one of least cost is refined.
    Usually only the newest frame is free while they compete. Before the stream is initialised,
    and where the window has unmeasured depths, the prior may be a wrong minimum: all frames after
    the anchor are free then.
    """
    anchor = len(history.frames)
    settled = history_of(prior).initialised and not history.has_unmeasured
    fixed = table.mask.shape[1] - 1 if settled else anchor + 1
    adjusted: dict[str, _Adjusted] = {}
    for candidate in _candidates(table, initialiser, prior, history):
        if candidate.competes(adjusted):
            adjusted[candidate.name] = _adjust(table, initialiser.focal, fixed, candidate.guess())
    return _refine(table, min(adjusted.values(), key=lambda each: each.cost), anchor)


@dataclass(frozen=True)
class _Adjusted:
    """A candidate after adjustment to all observations, of which ``inliers`` (F, P) fit."""

    problem: Problem
    state: State
    inliers: np.ndarray
    noise: float
    cost: float

    @property
    def newest_inlier_share(self) -> float:
        """Share of inliers among the newest frame's observations."""
        return float(self.inliers[-1].sum()) / max(1, self.problem.mask[-1].sum())


@dataclass(frozen=True)
class _Candidate:
    """An initial guess that ``competes`` or not, given the candidates adjusted before it."""

    name: str
    competes: Callable[[Mapping[str, _Adjusted]], bool]
    guess: Callable[[], InitialGuess]


def _candidates(table: TrackTable, initialiser: Initialiser, prior: WindowPrior | None,
                history: HistoryFrames) -> list[_Candidate]:
    """Return the candidates of a window in order; of equal costs the first wins."""
    candidates = []
    if prior is not None and prior.points is not None:
        candidates += [
            _Candidate('resection', lambda adjusted: True,
                       partial(initialiser.from_prior, table, prior, history)),
            _Candidate('epipolar geometry',
                       lambda adjusted: (adjusted['resection'].newest_inlier_share
                                         < MIN_INLIER_SHARE),
                       partial(initialiser.from_prior, table, prior, history, True)),
            _Candidate('history', lambda adjusted: history.has_unmeasured,
                       partial(initialiser.from_history, table, prior, history))]
    if not history_of(prior).initialised:
        pair = initialiser.best_pair(table)
        candidates.append(
            _Candidate('bootstrap', lambda adjusted: pair is not None or not adjusted,
                       partial(initialiser.bootstrap, table, pair)))
    return candidates


def _adjust(table: TrackTable, focal: float, fixed: int, guess: InitialGuess) -> _Adjusted:
    """Adjust from a guess and find outliers: a track with one wrong observation is one as a whole.

    It has slid before it became visibly wrong.
    """
    problem = _problem(table, focal, guess, fixed)
    state = ba.adjust(problem, guess.state, ITERATIONS)
    errors = reprojection.errors(problem, state)
    noise = _noise(problem, errors)
    largest = errors.max(axis=0) / problem.certainty
    fits = largest <= np.clip(MAX_NOISE_RATIO * noise, *MAX_ERROR_BOUNDS)
    return _Adjusted(problem, state, problem.mask & fits, noise,
                     reprojection.cost(problem, state))


def _refine(table: TrackTable, candidate: _Adjusted, anchor: int) -> Solution:
    """Adjust all frames after the anchor to the inliers, with a narrow loss."""
    problem = candidate.problem._replace(mask=candidate.inliers,
                                         width=FINAL_WIDTH * candidate.noise, fixed=anchor + 1)
    state = ba.adjust(problem, candidate.state, FINAL_ITERATIONS)
    return Solution(table, anchor, problem, state)


def _problem(table: TrackTable, focal: float, guess: InitialGuess, fixed: int) -> Problem:
    """Return the bundle adjustment problem of a window, with priors on depths."""
    expected = guess.expected_inverse_depths
    strength = np.where(guess.trusted, TRUSTED_DEPTH_PRIOR, DEPTH_PRIOR)
    spread = np.maximum(expected, MIN_PRIOR_SPREAD * numba_utils.median(expected))
    origins = geometry.make_transform(guess.state.rotations, guess.state.translations)
    return Problem(table.hosts, origins,
                   np.ascontiguousarray(table.image_points.transpose(1, 2, 0)),
                   np.ascontiguousarray(table.mask.T), focal, fixed, table.certainty,
                   strength / spread ** 2, expected, INITIAL_WIDTH)


def _noise(problem: Problem, errors: np.ndarray) -> float:
    """Return the noise [px] that fits the median of errors (F, P), 1 without observations.

    Fitted errors are smaller than the noise by the share of degrees of freedom.
    """
    typical, count = numba_utils.median_where(errors, problem.mask)
    if not count:
        return 1.0
    fitted = 3 * problem.mask.any(axis=0).sum() + 6 * (len(problem.mask) - problem.fixed)
    freedom = max(1.0 - fitted / (2 * count), MIN_FREEDOM)
    return max(MIN_NOISE, typical / math.sqrt(freedom))


def _regularised_inverse(system: np.ndarray) -> np.ndarray:
    """Return the inverse of a symmetric system, large in unobserved directions."""
    least = MIN_INFORMATION * system.diagonal().max()
    return np.linalg.inv(system + least * np.eye(len(system)))
