# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Augmented variants of sequences."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from PIL import Image, ImageEnhance

from kfvo_ros.sequences.base import Frame, Sequence
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.training.augmentation import Augmentation, SequenceVariant, jitter

FRAMES = 40
SAME = Augmentation(0.0, 0.0, 0.0, 0.0, drop_share=0.0, max_stride=1, reversal=False,
                    frames=FRAMES)
COLOURS = np.random.default_rng(0).integers(0, 256, (12, 10, 3), dtype=np.uint8)


@cache
def rendered() -> tuple[Frame, ...]:
    return tuple(SyntheticSequence(3, 'smooth', FRAMES, 160, 120))


def sequence() -> Sequence:
    class RenderedSequence(SyntheticSequence):
        """Returns the frames that are rendered already."""

        def __iter__(self):
            return iter(rendered())

    return RenderedSequence(3, 'smooth', FRAMES, 160, 120)


def variants(augmentation: Augmentation, count: int = 20) -> list[SequenceVariant]:
    return [SequenceVariant(sequence(), augmentation, number) for number in range(count)]


def stamps(variant: Sequence) -> list[int]:
    return [frame.stamp_ns for frame in variant]


def test_without_augmentation_nothing_changes():
    for ours, theirs in zip(SequenceVariant(sequence(), SAME, 5), sequence(), strict=True):
        np.testing.assert_array_equal(ours.image, theirs.image)
        assert ours.stamp_ns == theirs.stamp_ns


def test_the_number_seeds_the_variant():
    images = [np.stack([frame.image for frame in variants(Augmentation(), 3)[number]])
              for number in (1, 1, 2)]
    np.testing.assert_array_equal(images[0], images[1])
    assert images[0].shape != images[2].shape or (images[0] != images[2]).any()


@pytest.mark.parametrize('image', [COLOURS, COLOURS[:, :, 0]])
def test_colour_jitter_is_that_of_pillow(image):
    np.testing.assert_array_equal(jitter(image, 1.0, 1.0, 1.0), image)
    expected = ImageEnhance.Contrast(ImageEnhance.Brightness(Image.fromarray(image)).enhance(0.8))
    np.testing.assert_array_equal(jitter(image, 0.8, 1.2, 1.0), expected.enhance(1.2))
    grey = jitter(image, 1.0, 1.0, 0.0)
    assert grey.shape == image.shape and (image.ndim == 2 or np.ptp(grey, axis=2).max() == 0)


def test_brightness_stays_within_its_range():
    means = [next(iter(variant)).image.mean()
             for variant in variants(replace(SAME, brightness=0.25))]
    bright = next(iter(sequence())).image.mean()
    assert 0.74 * bright < min(means) < 0.9 * bright < 1.1 * bright < max(means) < 1.26 * bright


def test_calibration_errors_fill_their_range():
    true, calibrated = sequence().camera, [
        variant.camera for variant in variants(replace(SAME, calibration=0.02))]
    assert calibrated == [next(iter(variant)).camera
                          for variant in variants(replace(SAME, calibration=0.02))]
    focal = np.array([camera.fx / true.fx - 1.0 for camera in calibrated])
    radial = np.array([camera.distortion[0] for camera in calibrated])
    for off in (focal, radial):
        assert -0.02 < off.min() < -0.01 and 0.01 < off.max() < 0.02
    assert abs(np.corrcoef(focal, radial)[0, 1]) < 0.6
    pixel = np.array([[true.cx + true.fx, true.cy]])
    for camera, share, bend in zip(calibrated, focal, radial, strict=True):
        assert camera.fy / camera.fx == true.fy / true.fx
        assert camera.undistort(pixel)[0, 0] == pytest.approx(1.0 - share - bend, abs=4e-3)
    assert variants(SAME)[0].camera.undistort(pixel) == pytest.approx(true.undistort(pixel))


def test_frames_are_dropped_at_random_up_to_a_share():
    lengths = [len(stamps(variant)) for variant in variants(replace(SAME, drop_share=0.5))]
    assert max(lengths) <= FRAMES and min(lengths) < 0.75 * FRAMES and len(set(lengths)) > 5
    assert np.mean(lengths) == pytest.approx(0.75 * FRAMES, rel=0.1)


def test_strides_and_starts_vary():
    whole = stamps(sequence())
    strides, starts = set(), set()
    for variant in variants(replace(SAME, max_stride=3, frames=10)):
        seen = [whole.index(stamp_ns) for stamp_ns in stamps(variant)]
        assert len(seen) == 10 and len(set(np.diff(seen))) == 1
        strides.add(int(seen[1] - seen[0]))
        starts.add(seen[0])
    assert strides == {1, 2, 3} and len(starts) > 5


def test_backwards_frames_and_truth_match():
    backwards = [variant for variant in variants(replace(SAME, reversal=True))
                 if (next(iter(variant)).image != next(iter(sequence())).image).any()]
    assert 4 < len(backwards) < 16
    frames = list(backwards[0])
    np.testing.assert_array_equal(frames[0].image, list(sequence())[-1].image)
    there, back = (each.ground_truth().trajectory for each in (sequence(), backwards[0]))
    assert [frame.stamp_ns for frame in frames] == list(back.stamps_ns)
    assert (np.diff(back.stamps_ns) > 0).all()
    np.testing.assert_array_equal(back.poses[::-1], there.poses)


def test_a_rolling_shutter_never_runs_backwards():
    class RollingSequence(Sequence):
        name, camera = 'rolling', replace(sequence().camera, readout_s=0.03)
        length = 3

        def __iter__(self):
            return (Frame(1 + number, COLOURS, None) for number in range(3))

    augmentation = replace(SAME, reversal=True)
    for number in range(20):
        assert stamps(SequenceVariant(RollingSequence(), augmentation, number)) == [1, 2, 3]


def test_a_sequence_without_truth_or_camera_has_variants_too():
    class PlainSequence(Sequence):
        name, camera, length = 'plain', None, None

        def __iter__(self):
            return (Frame(1 + number, COLOURS, None) for number in range(3))

    variant = SequenceVariant(PlainSequence(), Augmentation(), 1)
    assert variant.ground_truth() is None and len(list(variant)) > 0
