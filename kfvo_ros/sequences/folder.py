# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A plain folder of images, in the order of their names."""

from __future__ import annotations

from pathlib import Path

from kfvo_ros.sequences.calibration import Calibration
from kfvo_ros.sequences.image_list import ImageListSequence, list_images, stamps_at_rate
from kfvo_ros.sequences.kind import Kind, Options


def open_folder(path: Path, options: Options) -> ImageListSequence:
    """Open the images of a folder, stamped at the rate of the options."""
    stamp_of = stamps_at_rate(options.rate)
    images = [(stamp_of(index), name) for index, name in enumerate(list_images(path))]
    return ImageListSequence(path.name, path, images, Calibration(options.camera, path))


KIND = Kind('folder', 'a folder of images', lambda path: path.is_dir() and bool(list_images(path)),
            open_folder)
