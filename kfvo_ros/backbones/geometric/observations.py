# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Who sees what in a window: tracks as a table of points by frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kfvo_ros.backbones.geometric import kernels
from kfvo_ros.backbones.geometric.lens import Lens
from kfvo_ros.tracking import Tracks

HALF_BELIEVED = 0.1
"""A track whose patches part by so much in each frame weighs half as much as one that is sure
[px]."""


@dataclass(frozen=True)
class View:
    """What one frame sees: ``tracks`` in pixels, and where they lie undistorted.

    ``points`` (N, 2) are normalised, undistorted coordinates of the same tracks, by the
    calibration; ``index`` counts the input frames of the stream.
    """

    index: int
    tracks: Tracks
    points: np.ndarray


@dataclass(frozen=True)
class Observations:
    """The tracks that at least two of F frames see.

    ``ids`` (P,) increasing; ``seen`` (P, F, 2) normalised coordinates under ``mask`` (P, F);
    ``hosts`` (P,) the first frame that sees a point and ``rays`` (P, 3) its ray there; its tracks
    are to be believed ``certainty`` (P,) times as much as the best.
    """

    ids: np.ndarray
    seen: np.ndarray
    mask: np.ndarray
    hosts: np.ndarray
    rays: np.ndarray
    certainty: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)


def tabulate(views: Sequence[View], anchor: int, lens: Lens) -> Observations:
    """Gather the tracks of `views`, oldest first, that a frame after the anchor sees."""
    ids, seen, mask, hosts, doubts = kernels.merge(
        np.concatenate([view.tracks.ids for view in views]),
        lens.straighten(np.concatenate([view.points for view in views])),
        np.concatenate([view.tracks.doubts for view in views]),
        np.cumsum([len(view.points) for view in views]), anchor + 1)
    rays = np.ones((len(ids), 3))
    rays[:, :2] = seen[np.arange(len(ids)), hosts]
    return Observations(ids, seen, mask, hosts, rays,
                        1.0 / np.sqrt(1.0 + np.square(doubts / HALF_BELIEVED)))
