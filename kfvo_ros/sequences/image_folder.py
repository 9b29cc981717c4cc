# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Image files with stamps: what most datasets are once their index is read."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.images import read_image
from kfvo_ros.sequences.base import (
    BODY_FRAME,
    Calibration,
    FixedTransform,
    Frame,
    GroundTruth,
    Sequence,
    SequenceKind,
    SequenceSettings,
)
from kfvo_ros.trajectory import NANOSECONDS

IMAGE_SUFFIXES = frozenset(('.png', '.jpg', '.jpeg', '.bmp', '.pgm', '.ppm', '.tif', '.tiff',
                            '.webp'))
_log = logging.getLogger(__name__)


class ImageListSequence(Sequence):
    """Stamped image files of one folder, decoded one at a time.

    `images` are (stamp_ns, file name); a stamp that does not come after the one before it is
    left out with a warning. The first image is read at once: its size decides the camera.
    """

    camera: Camera

    def __init__(self, name: str, folder: Path, images: Iterable[tuple[int, str]],
                 calibration: Calibration,
                 ground_truth: Callable[[], GroundTruth | None] = lambda: None,
                 T_body_camera: Callable[[], np.ndarray | None] = lambda: None) -> None:
        self.name = name
        self._folder = folder
        self._images = _in_time_order(name, images)
        self._read_ground_truth = ground_truth
        self._read_T_body_camera = T_body_camera
        if not self._images:
            raise KfvoError(f'{name}: expected images in {folder}, none is listed')
        height, width = read_image(folder / self._images[0][1]).shape[:2]
        self.camera = calibration.camera(name, width, height)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; KfvoError naming a file that is missing, broken or of other size."""
        size = (self.camera.width, self.camera.height)
        for stamp_ns, file_name in self._images:
            path = self._folder / file_name
            image = read_image(path)
            if image.shape[1::-1] != size:
                raise KfvoError(f'{path} is {image.shape[1]}x{image.shape[0]}, the images before '
                                f'it are {size[0]}x{size[1]}; a sequence has one size')
            yield Frame(stamp_ns, image, self.camera)

    @property
    def length(self) -> int:
        """Number of frames."""
        return len(self._images)

    def ground_truth(self) -> GroundTruth | None:
        """Return the measured trajectory, read at the call, or None where there is none."""
        return self._read_ground_truth()

    def extrinsics(self) -> tuple[FixedTransform, ...]:
        """Return where the camera is on the body, read at the call, where the dataset says it."""
        T_body_camera = self._read_T_body_camera()
        return () if T_body_camera is None else (
            FixedTransform(BODY_FRAME, self.camera_frame, T_body_camera),)


def list_images(folder: Path) -> list[str]:
    """Return the names of the image files of a folder, 9.png before 10.png."""
    try:
        names = [path.name for path in folder.iterdir()
                 if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith('.')]
    except OSError as error:
        raise KfvoError(f'cannot list the folder {folder}: {reason_of(error)}') from error
    return sorted(names, key=_natural_order)


def stamps_at_rate(rate: float) -> Callable[[int], int]:
    """Return stamp_ns of frame 0, 1, 2 ... at `rate` [Hz], in integers.

    The rate is taken as the simple fraction it means: 29.97003 is 30000/1001.
    """
    fraction = Fraction(rate).limit_denominator(1_000_000) if math.isfinite(rate) else Fraction(0)
    if fraction <= 0:
        raise KfvoError(f'expected a positive number of frames per second, {rate} came')
    return lambda index: index * NANOSECONDS * fraction.denominator // fraction.numerator


def _natural_order(name: str) -> list[tuple[int, str]]:
    """Return a sort key that compares runs of digits as numbers."""
    return [(int(part), '') if part.isdigit() and part.isascii() else (-1, part)
            for part in re.split(r'([0-9]+)', name)]


def _in_time_order(name: str, images: Iterable[tuple[int, str]]) -> list[tuple[int, str]]:
    """Drop images whose stamp does not come after the one before, and say how many."""
    kept: list[tuple[int, str]] = []
    dropped = 0
    for stamp_ns, file_name in images:
        if kept and stamp_ns <= kept[-1][0]:
            dropped += 1
        else:
            kept.append((stamp_ns, file_name))
    if dropped:
        _log.warning('%s: left out %d images whose stamps do not increase', name, dropped)
    return kept


def open_folder(path: Path, options: SequenceSettings) -> ImageListSequence:
    """Open the images of a folder, stamped at the rate of the options."""
    stamp_of = stamps_at_rate(options.rate)
    images = [(stamp_of(index), name) for index, name in enumerate(list_images(path))]
    return ImageListSequence(path.name, path, images, Calibration(options.camera, path))


KIND = SequenceKind('folder', 'a folder of images', lambda path: path.is_dir() and bool(list_images(path)),
                    open_folder)
