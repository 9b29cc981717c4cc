# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences of stamped image files: the base of most datasets, and plain folders."""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, printable, reason_of
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
from kfvo_ros.sequences.stamps import PERSISTENCE, OrderedImages
from kfvo_ros.trajectory import NANOSECONDS, format_stamp

IMAGE_SUFFIXES = frozenset(('.png', '.jpg', '.jpeg', '.bmp', '.pgm', '.ppm', '.tif', '.tiff',
                            '.webp'))
_log = logging.getLogger(__name__)


class ImageListSequence(Sequence):
    """Stamped image files of one folder, decoded one at a time.

    `images` are (stamp_ns, file name); those that are late or have an odd stamp are left out with
    a warning. `ground_truth` and `T_body_camera` are read at the call of `ground_truth` and
    `extrinsics`. The first image is read at construction, because the camera depends on its
    size. Raises KfvoError without images, and for a first image or calibration that is broken.
    """

    camera: Camera

    def __init__(self, name: str, folder: Path, images: Iterable[tuple[int, str]],
                 calibration: Calibration,
                 ground_truth: Callable[[], GroundTruth | None] = lambda: None,
                 T_body_camera: Callable[[], np.ndarray | None] = lambda: None) -> None:
        self.name = printable(name)
        self._folder = folder
        self._images, self._left_out = _select_ordered(self.name, images)
        self._read_ground_truth = ground_truth
        self._read_T_body_camera = T_body_camera
        if not self._images:
            raise KfvoError(f'{name}: expected images in {folder}, none is listed')
        height, width = read_image(folder / self._images[0][1]).shape[:2]
        self.camera = calibration.camera(self.name, width, height)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; raises KfvoError for a missing, broken or differently sized file."""
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

    @property
    def left_out(self) -> dict[str, int]:
        """Number of images left out, by the reason."""
        return dict(self._left_out)

    def ground_truth(self) -> GroundTruth | None:
        """Read and return the measured trajectory, None where there is none."""
        return self._read_ground_truth()

    def extrinsics(self) -> tuple[FixedTransform, ...]:
        """Read and return the transform from the body to the camera, empty if unknown."""
        T_body_camera = self._read_T_body_camera()
        return () if T_body_camera is None else (
            FixedTransform(BODY_FRAME, self.camera_frame, T_body_camera),)


def list_images(folder: Path) -> list[str]:
    """Return the names of a folder's image files in natural order: 9.png before 10.png.

    ``a (1).png``, a copy of ``a.png``, follows it.
    """
    try:
        names = [path.name for path in folder.iterdir()
                 if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith('.')
                 and not path.is_dir()]
    except OSError as error:
        raise KfvoError(f'cannot list the folder {folder}: {reason_of(error)}') from error
    return sorted(names, key=_natural_order)


def stamps_at_rate(rate: float) -> Callable[[int], int]:
    """Return the function from frame index to stamp_ns at `rate` [Hz], in integer arithmetic.

    The rate becomes the nearest simple fraction (29.97003 is 30000/1001), so stamps do not
    drift. Raises KfvoError for a rate that is not positive and finite.
    """
    fraction = Fraction(rate).limit_denominator(1_000_000) if math.isfinite(rate) else Fraction(0)
    if fraction <= 0:
        raise KfvoError(f'expected a positive number of frames per second, {rate} came')
    return lambda index: index * NANOSECONDS * fraction.denominator // fraction.numerator


def open_folder(path: Path, settings: SequenceSettings) -> ImageListSequence:
    """Open the images of a folder, stamped at the rate of the settings."""
    stamp_at = stamps_at_rate(settings.rate)
    images = [(stamp_at(index), name) for index, name in enumerate(list_images(path))]
    return ImageListSequence(path.name, path, images, Calibration(settings.camera, path))


def _matches(path: Path) -> bool:
    return path.is_dir() and bool(list_images(path))


KIND = SequenceKind('folder', 'a folder of images', _matches, open_folder)


def _natural_order(name: str) -> tuple[list[tuple[Decimal, str]], str]:
    """Return a sort key: runs of digits compare as numbers, without the suffix.

    Seconds since 1970 may have decimals, of which Python leaves out zeros at the end.
    """
    stem = os.path.splitext(name)[0]
    return [(Decimal(part), '') if index % 2 else (Decimal(-1), part)
            for index, part in enumerate(re.split(r'([0-9]{9,}\.[0-9]+|[0-9]+)', stem))], name


def _select_ordered(name: str, images: Iterable[tuple[int, str]]
                    ) -> tuple[list[tuple[int, str]], dict[str, int]]:
    """Return the images with credible, increasing stamps, and the numbers of the others.

    Raises KfvoError for three and more stamps that are all the same.
    """
    images = list(images)
    if len(images) >= PERSISTENCE and len({stamp_ns for stamp_ns, _ in images}) == 1:
        raise KfvoError(f'{name}: expected increasing stamps, all {len(images)} images have '
                        f'{format_stamp(images[0][0])} s; put them right, or use the folder of '
                        'the images with --kind folder and --rate')
    ordered: OrderedImages[str] = OrderedImages()
    kept = list(ordered.select((stamp_ns, None, file_name) for stamp_ns, file_name in images))
    left_out = dict(ordered.left_out)
    if left_out:
        _log.warning('%s: left out %d images whose stamps do not increase or are odd', name,
                     sum(left_out.values()))
    return kept, left_out
