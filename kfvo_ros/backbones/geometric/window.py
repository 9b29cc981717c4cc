# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One window from tracks to poses: first guess, bundle adjustment, outliers, covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Points, Previous
from kfvo_ros.backbones.geometric import bundle_adjustment as ba
from kfvo_ros.backbones.geometric.initialisation import Initialiser, known_inverse_depths
from kfvo_ros.backbones.geometric.observations import Observations

MIN_TRACKS = 8
"""The newest frame needs as many tracks in common with the window to be placed."""
WARM_FRAMES = 4
"""Smaller windows are started from nothing: too little is known of them to hold on to."""
ITERATIONS, FINAL_ITERATIONS = 8, 4
MAX_ERROR = 3.0
"""Observations farther off after the first adjustment are outliers [px]."""
DEPTH_PRIOR = 1.0
"""How strongly a point keeps its last depth: one such prior weighs as much as a residual of
1 px for a depth wrong by 100 %. It keeps the scale through rotation and hovering."""
PRIOR_FLOOR = 0.2
PIXEL_NOISE_FLOOR = 0.1
"""Tracks are never believed to be better than this [px]."""


@dataclass(frozen=True)
class Solution:
    """A solved window; ``inliers`` (P, F) is what is left of the observations."""

    observations: Observations
    state: ba.State
    inliers: np.ndarray
    errors: np.ndarray
    normal: ba.NormalEquations

    @property
    def solved(self) -> np.ndarray:
        """Mask (P,) of the points that at least two frames still agree on."""
        return self.inliers.sum(axis=1) >= 2

    @property
    def T_anchor_frame(self) -> np.ndarray:
        """Poses (F, 4, 4)."""
        return geometry.make_transform(self.state.rotations, self.state.translations)

    def points(self) -> Points:
        """Return the solved points; a depth's information is that given the poses."""
        rows = self.solved
        hosts = self.observations.hosts[rows]
        inverse_depths = self.state.inverse_depths[rows]
        rays = self.observations.rays[rows] / inverse_depths[:, None]
        positions = np.einsum('pij,pj->pi', self.state.rotations[hosts], rays)
        return Points(self.observations.ids[rows], positions + self.state.translations[hosts],
                      self.normal.H_pp[rows] * inverse_depths ** 2)

    def covariance(self) -> np.ndarray:
        """Return covariances (F, 6, 6) in the anchor, translation first, anchor's zero.

        The scale of the window is part of it, tied to the past by the depth priors alone: it
        grows where points have no parallax, which reprojection errors would not show.
        """
        frames = len(self.state.rotations)
        covariance = np.zeros((frames, 6, 6))
        free = np.arange(6, 6 * frames)
        system, _ = self.normal.reduce(0.0, free)
        rms = np.median(self.errors[self.inliers & (self.errors > 0)]) if self.inliers.any() else 1.0
        noise = max(PIXEL_NOISE_FLOOR, float(rms)) ** 2
        blocks = noise * np.linalg.pinv(system, hermitian=True)
        for frame in range(1, frames):
            block = blocks[6 * frame - 6:6 * frame, 6 * frame - 6:6 * frame]
            turn = np.zeros((6, 6))
            turn[:3, 3:] = np.eye(3)
            turn[3:, :3] = self.state.rotations[frame]
            covariance[frame] = turn @ block @ turn.T
        return 0.5 * (covariance + np.swapaxes(covariance, 1, 2))


def solve(observations: Observations, initialiser: Initialiser,
          previous: Previous | None) -> Solution:
    """Place the frames of a window in the anchor, in the unit of `previous`, else median depth 1."""
    frames = observations.mask.shape[1]
    warm = previous is not None and previous.points is not None and frames >= WARM_FRAMES
    if warm:
        state = initialiser.from_previous(observations, previous)
    else:
        state = initialiser.from_nothing(observations)
        state = state.scaled(float(np.median(state.inverse_depths)))
    problem = _problem(observations, initialiser.focal, state, previous if warm else None)
    state = ba.adjust(problem, state, ITERATIONS)
    inliers = observations.mask & (ba.reprojection_errors(problem, state) <= MAX_ERROR)
    inliers &= (inliers.sum(axis=1) >= 2)[:, None]
    if (inliers != observations.mask).any():
        problem = problem.observed(inliers)
        state = ba.adjust(problem, state, FINAL_ITERATIONS)
    return Solution(observations, state, inliers, ba.reprojection_errors(problem, state),
                    ba.linearise(problem, state))


def _problem(observations: Observations, focal: float, state: ba.State,
             previous: Previous | None) -> ba.Problem:
    """Return the bundle adjustment of a window, depths drawn to where they were or the median."""
    expected = np.full(len(observations), np.median(state.inverse_depths))
    if previous is not None:
        poses = geometry.make_transform(state.rotations, state.translations)
        known = known_inverse_depths(observations, poses, previous)
        expected = np.where(np.isfinite(known), known,
                            np.median(known[np.isfinite(known)]) if np.isfinite(known).any() else expected)
    spread = np.maximum(expected, PRIOR_FLOOR * np.median(expected))
    fixed = np.zeros(observations.mask.shape[1], dtype=bool)
    fixed[0] = True
    return ba.Problem(observations.hosts, observations.rays, observations.seen, observations.mask,
                      focal, fixed, DEPTH_PRIOR / spread ** 2, expected)
