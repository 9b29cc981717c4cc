# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scale of a window relative to the trajectory: the rules `none`, `translation` and `depth`."""

from __future__ import annotations

import numpy as np

from kfvo_ros.backbones.base import Estimate, Points, WindowPrior
from kfvo_ros.tracking import tracker

SCALE_RULES = ('none', 'translation', 'depth')
MIN_SHARED_POINTS = 8
"""Fewer shared points do not determine the scale."""
STANDSTILL = 1e-3
"""Keyframes closer to the anchor than this share of the window's extent determine no scale."""
MIN_AGREEMENT = 0.98
"""Below this cosine between known and new positions they determine no scale: at standstill both
are noise, and the scale would drift with their ratio."""


class ScaleAligner:
    """Estimates trajectory units per unit of a window; keeps the last scale and depths.

    `rule`: ``none`` uses the backbone's unit (the paper's rule), ``translation`` compares the
    distances of the keyframes to the anchor with the known ones, ``depth`` compares the depths
    of shared points and falls back to ``translation`` without them.
    """

    def __init__(self, rule: str) -> None:
        self.rule = rule
        self._last = 1.0
        self._depths = np.ones(1)

    def align(self, estimate: Estimate, prior: WindowPrior | None) -> float:
        """Return the factor that brings `estimate` into trajectory units."""
        if self.rule == 'none':
            return 1.0
        if prior is None or (prior.points is None and estimate.points is not None):
            self._last = self._from_median_depth(estimate.points)
        else:
            scale = None
            if self.rule == 'depth':
                scale = compare_depths(prior.points, estimate.points)
            if scale is None:
                scale = compare_translations(prior.T_anchor_frame, estimate.T_anchor_frame)
            self._last = self._last if scale is None else scale
        if estimate.points is not None and len(estimate.points.ids):
            self._depths = self._last * estimate.points.depths
        return self._last

    def _from_median_depth(self, points: Points | None) -> float:
        """Return the scale that starts a segment at the last median depth, the first at 1."""
        if points is None or len(points.ids) == 0:
            return self._last
        return float(np.median(self._depths) / np.median(points.depths))


def compare_depths(known: Points | None, new: Points | None) -> float | None:
    """Return the information-weighted median ratio of known to new depths."""
    if known is None or new is None:
        return None
    in_known, in_new = tracker.match_ids(known.ids, new.ids)
    if len(in_known) < MIN_SHARED_POINTS:
        return None
    ratios = known.depths[in_known] / np.maximum(new.depths[in_new], 1e-12)
    weights = np.minimum(known.information[in_known], new.information[in_new])
    order = np.argsort(ratios)
    cumulative = np.cumsum(weights[order])
    if cumulative[-1] <= 0.0:
        return None
    return float(ratios[order[np.searchsorted(cumulative, 0.5 * cumulative[-1])]])


def compare_translations(known: np.ndarray, new: np.ndarray) -> float | None:
    """Return the least-squares ratio of the keyframes' distances to the anchor.

    `known` (S - 1, 4, 4) and `new` (S, 4, 4) are poses in the anchor; None at standstill.
    """
    known_positions, new_positions = known[1:, :3, 3], new[1:len(known), :3, 3]
    a, b = np.linalg.norm(known_positions, axis=1), np.linalg.norm(new_positions, axis=1)
    extent = np.linalg.norm(new[:, :3, 3], axis=1).max()
    agreement = (known_positions * new_positions).sum()
    if (b @ b <= (STANDSTILL * extent) ** 2
            or agreement <= MIN_AGREEMENT * np.linalg.norm(a) * np.linalg.norm(b)):
        return None
    return float(a @ b / (b @ b))
