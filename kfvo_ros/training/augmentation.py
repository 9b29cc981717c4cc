# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Augmentation of sequences: light, frame rate, direction and calibration."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from PIL import Image, ImageEnhance

from kfvo_ros.sequences.base import Frame, GroundTruth, Sequence


@dataclass(frozen=True)
class Augmentation:
    """Ranges of the random variants of a sequence.

    ``brightness``, ``contrast`` and ``saturation`` are factors within 1 +- these; the calibrated
    focal length and first distortion coefficient are wrong by up to ``calibration``; every k-th
    frame is used, k up to ``max_stride``, and of these each is dropped with a probability of up
    to ``drop_share``; with ``reversal`` half of the variants run backwards. A variant has at most
    ``frames`` frames, from a random start. Source, except for the calibration: the paper, section
    IV-E.
    """

    brightness: float = 0.4
    contrast: float = 0.4
    saturation: float = 0.4
    calibration: float = 0.01
    drop_share: float = 0.1
    max_stride: int = 2
    reversal: bool = True
    frames: int = 200


class SequenceVariant(Sequence):
    """Variant of the first `stop` frames of a sequence, reproducible by its `number`."""

    def __init__(self, sequence: Sequence, augmentation: Augmentation, number: int,
                 stop: int | None = None) -> None:
        self._sequence, self._frames, self._stop = sequence, augmentation.frames, stop
        self._rng_seed = (number, zlib.crc32(sequence.name.encode()))
        rng = np.random.default_rng(self._rng_seed)
        self.name = f'{sequence.name} variant {number}'
        self.camera = sequence.camera and sequence.camera.miscalibrated(
            *np.random.default_rng((*self._rng_seed, 2)).uniform(
                -augmentation.calibration, augmentation.calibration, 2))
        self._factors = [rng.uniform(1.0 - reach, 1.0 + reach) for reach in (
            augmentation.brightness, augmentation.contrast, augmentation.saturation)]
        self._drop_share = rng.uniform(0.0, augmentation.drop_share)
        self._stride = int(rng.integers(1, augmentation.max_stride, endpoint=True))
        length = sequence.length or 0 if stop is None else min(stop, sequence.length or stop)
        spare = length - augmentation.frames * self._stride
        self._start = int(rng.integers(0, max(spare, 0), endpoint=True))
        # The rows of a rolling shutter are not exposed in reverse.
        rolling = sequence.camera is not None and sequence.camera.readout_s > 0.0
        self._backwards = augmentation.reversal and not rolling and bool(rng.integers(2))

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; a backwards variant holds all images in memory."""
        rng = np.random.default_rng((*self._rng_seed, 1))
        strided = islice(self._sequence, self._start, self._stop, self._stride)
        frames: Iterator[Frame] = islice(
            (frame for frame in strided if rng.random() >= self._drop_share), self._frames)
        if self._backwards:
            stamp_sum_ns = self._stamp_sum_ns()
            frames = (replace(frame, stamp_ns=stamp_sum_ns - frame.stamp_ns)
                      for frame in reversed(list(frames)))
        for frame in frames:
            yield replace(frame, image=jitter(frame.image, *self._factors), camera=self.camera)

    @property
    def length(self) -> None:
        """None: the number of frames is not known in advance."""
        return None

    def ground_truth(self) -> GroundTruth | None:
        """Return the ground truth of the sequence, reversed where the frames are."""
        truth = self._sequence.ground_truth()
        if truth is None or not self._backwards:
            return truth
        forward = truth.trajectory
        backward = replace(forward, stamps_ns=self._stamp_sum_ns() - forward.stamps_ns[::-1],
                           poses=forward.poses[::-1])
        return replace(truth, trajectory=backward)

    def _stamp_sum_ns(self) -> int:
        """Return the sum of a stamp and its mirrored stamp."""
        truth = self._sequence.ground_truth()
        if truth is None or not len(truth.trajectory.stamps_ns):
            return 0
        return int(truth.trajectory.stamps_ns[0] + truth.trajectory.stamps_ns[-1])


def jitter(image: np.ndarray, brightness: float, contrast: float,
           saturation: float) -> np.ndarray:
    """Return the colour-jittered image (H, W) or (H, W, 3) RGB uint8; a factor of 1 is neutral."""
    picture = Image.fromarray(image)
    for enhance, factor in ((ImageEnhance.Brightness, brightness),
                            (ImageEnhance.Contrast, contrast), (ImageEnhance.Color, saturation)):
        picture = enhance(picture).enhance(factor)
    return np.asarray(picture)
