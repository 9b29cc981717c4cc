# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences as they might have been recorded: another light, pace, direction or calibration."""

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
    """How far variants of a sequence may go from it.

    ``brightness``, ``contrast`` and ``saturation`` of a variant are factors within 1 +- these;
    its focal length and its lens are believed to be off by up to ``calibration``; a frame is left
    out with a probability of up to ``drop_share``; of the others every k-th is taken, k up to
    ``max_stride``, and with ``reversal`` one variant in two runs backwards. A variant has
    ``frames`` at most, from anywhere. Source, but for the calibration: the paper, section IV-E.
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
    """One variant of a sequence, of its first `stop` frames: the same number, the same variant."""

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
        # What a rolling shutter did cannot be read backwards.
        rolling = sequence.camera is not None and sequence.camera.readout_s > 0.0
        self._backwards = augmentation.reversal and not rolling and bool(rng.integers(2))

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; of a variant that runs backwards all images are held."""
        rng = np.random.default_rng((*self._rng_seed, 1))
        seen = islice(self._sequence, self._start, self._stop, self._stride)
        frames: Iterator[Frame] = islice(
            (frame for frame in seen if rng.random() >= self._drop_share), self._frames)
        if self._backwards:
            mirror = self._mirror_ns()
            frames = (replace(frame, stamp_ns=mirror - frame.stamp_ns)
                      for frame in reversed(list(frames)))
        for frame in frames:
            yield replace(frame, image=jitter(frame.image, *self._factors), camera=self.camera)

    @property
    def length(self) -> None:
        """Nobody knows before."""
        return None

    def ground_truth(self) -> GroundTruth | None:
        """Return the sequence's, backwards where the frames are."""
        truth = self._sequence.ground_truth()
        if truth is None or not self._backwards:
            return truth
        there = truth.trajectory
        back = replace(there, stamps_ns=self._mirror_ns() - there.stamps_ns[::-1],
                       poses=there.poses[::-1])
        return replace(truth, trajectory=back)

    def _mirror_ns(self) -> int:
        """Return the sum of a stamp and the one it becomes."""
        truth = self._sequence.ground_truth()
        if truth is None or not len(truth.trajectory.stamps_ns):
            return 0
        return int(truth.trajectory.stamps_ns[0] + truth.trajectory.stamps_ns[-1])


def jitter(image: np.ndarray, brightness: float, contrast: float,
           saturation: float) -> np.ndarray:
    """Return the image (H, W) or (H, W, 3) RGB uint8 under another light; 1 changes nothing."""
    picture = Image.fromarray(image)
    for enhance, factor in ((ImageEnhance.Brightness, brightness),
                            (ImageEnhance.Contrast, contrast), (ImageEnhance.Color, saturation)):
        picture = enhance(picture).enhance(factor)
    return np.asarray(picture)
