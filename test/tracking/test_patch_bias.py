# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bias of patches that cover a near and a far surface at once."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kfvo_ros.tracking import tracker
from kfvo_ros.tracking.tracker import Tracker, common_pixels

SHAPE = (240, 320)


def two_layers(seed: int, count: int, near: float, far: float) -> list[np.ndarray]:
    """Return images of near discs in front of a far plane, moving `near` and `far` [px/frame]."""
    rng, (height, width), margin = np.random.default_rng(seed), SHAPE, 80
    back, front = (cv2.GaussianBlur(rng.random((height, width + margin), dtype=np.float32),
                                    (0, 0), 1.5) for _ in range(2))
    back, front = (cv2.normalize(each, None, *reach, cv2.NORM_MINMAX)
                   for each, reach in ((back, (20.0, 200.0)), (front, (60.0, 250.0))))
    cover = np.zeros_like(back)
    for x, y in rng.uniform((0, 0), (width + margin, height), (30, 2)):
        cv2.circle(cover, (int(x), int(y)), 12, 1.0, -1)
    cover = cv2.GaussianBlur(cover, (0, 0), 0.7)

    def shifted(layer: np.ndarray, by: float) -> np.ndarray:
        return cv2.warpAffine(layer, np.float32([[1, 0, by - margin], [0, 1, 0]]), (width, height))

    images = []
    for index in range(count):
        share = shifted(cover, near * index)
        seen = share * shifted(front, near * index) + (1.0 - share) * shifted(back, far * index)
        images.append(np.clip(seen, 0.0, 255.0).astype(np.uint8))
    return images


@pytest.mark.parametrize('seed', [0, 1, 2])
def test_biased_tracks_are_uncertain_and_corrected(monkeypatch, seed):
    near, far, frames = 2.0, 0.5, 16
    images, errors = two_layers(seed, frames, near, far), []
    for bias in (0.0, tracker.PATCH_BIAS):
        monkeypatch.setattr(tracker, 'PATCH_BIAS', bias)
        fresh_tracker = Tracker()
        first, *_, last = [fresh_tracker.track(image) for image in images]
        before, after = common_pixels(first, last)
        uncertainty = last.uncertainty[np.isin(last.ids, first.ids)]
        off = after - before - np.array([[[near, 0.0]], [[far, 0.0]]]) * (frames - 1)
        errors.append(np.linalg.norm(off, axis=2).min(axis=0))
    assert (errors[0] > 1.0).sum() > 50 and (errors[0] < 0.3).sum() > 50
    assert np.median(uncertainty[errors[0] > 1.0]) > 10.0 * np.median(uncertainty[errors[0] < 0.3])
    biased = (errors[0] > 0.5) & (errors[0] < 4.0)  # larger errors belong to neither surface
    assert (errors[1] < errors[0])[biased].mean() > 0.75
    assert errors[1][biased].mean() < 0.94 * errors[0][biased].mean()
