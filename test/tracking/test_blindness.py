# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Blind images: flat ones, sensor noise, a covered lens; and dark or noisy ones that are not."""

from __future__ import annotations

import warnings

import cv2
import numpy as np
import pytest
from blind_images import KINDS, blind_image, to_bytes
from odometry_scenes import frames_of

from kfvo_ros.tracking.blindness import is_blind, is_flat
from kfvo_ros.tracking.tracker import MAX_SKIPPED, Tracker, common_pixels


@pytest.mark.parametrize('kind', KINDS)
def test_images_that_show_nothing_are_blind(kind):
    rng = np.random.default_rng(0)
    for shape, count in (((1080, 1920), 1), ((480, 640), 5), ((240, 320), 10), ((120, 160), 10)):
        assert all(is_blind(blind_image(kind, shape, rng)) for _ in range(count)), shape


def test_demosaicked_noise_is_blind():
    rng = np.random.default_rng(0)
    for _ in range(5):
        raw = to_bytes(8.0 + 4.0 * rng.normal(size=(480, 640)))
        colour = cv2.cvtColor(raw, cv2.COLOR_BayerBG2BGR)
        assert is_blind(cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize('style', ['smooth', 'fast', 'street'])
def test_dark_and_noisy_images_are_not_blind(style):
    rng = np.random.default_rng(0)
    for frame in frames_of(1, 60, style)[::6]:
        image, noise = frame.image, rng.normal(size=frame.image.shape)
        small = cv2.resize(image, (80, 60), interpolation=cv2.INTER_AREA)
        for variant in (image, small, image // 10, 255 - image // 10, to_bytes(image / 10 + noise),
                        to_bytes(image + 30.0 * noise), cv2.GaussianBlur(image, (0, 0), 6.0)):
            assert not is_blind(variant)


def test_fine_grain_and_few_corners_are_not_blind():
    noise = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
    assert not is_blind(cv2.GaussianBlur(noise, (0, 0), 1.0))
    dots = np.full((480, 640), 120, dtype=np.uint8)
    for x in range(5):
        cv2.circle(dots, (100 + 90 * x, 80 + 60 * x), 5, 20, -1)
    assert not is_blind(dots)


@pytest.mark.parametrize('shape', [(1, 1), (1, 300_000), (300_000, 1), (5, 300), (2, 3), (9, 9)])
def test_images_of_any_shape_are_accepted(shape):
    rng = np.random.default_rng(0)
    for image in (np.zeros(shape, np.uint8), rng.integers(0, 256, shape, dtype=np.uint8)):
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            assert not (is_blind(image) and is_flat(image) and image.any())


@pytest.mark.parametrize(('count', 'resumed'), [(1, True), (MAX_SKIPPED, True),
                                                (MAX_SKIPPED + 1, False), (40, False)])
def test_tracks_are_resumed_after_a_few_blind_images(count, resumed):
    rng = np.random.default_rng(0)
    image = frames_of(0)[0].image
    tracker = Tracker()
    before = tracker.track(image)
    for _ in range(count):
        assert len(tracker.track(blind_image('black, noise 3', image.shape, rng))) == 0
    after = tracker.track(image)
    assert len(after) > 100
    assert (len(common_pixels(before, after)[0]) > 0.9 * len(before)) == resumed


def test_tracking_does_not_start_in_a_blind_image():
    rng = np.random.default_rng(0)
    tracker = Tracker()
    for kind in KINDS:
        assert len(tracker.track(blind_image(kind, (240, 320), rng))) == 0
    assert len(tracker.track(frames_of(0)[0].image)) > 100
