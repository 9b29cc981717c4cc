# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images in the size that the model expects: the official loader's ``crop`` mode.

A fixed width, whole patches, Pillow's bicubic filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image

from kfvo_ros.backbones.vggt.config import PATCH_SIZE
from kfvo_ros.errors import KfvoError

MAX_HEIGHT_TO_WIDTH = 16
"""Higher images would be resized to an enormous height before they are cropped."""


@dataclass(frozen=True)
class ImageFit:
    """Resize and crop of images of one native size.

    An image is resized to (``height``, ``width``), then cropped to the middle ``rows``, starting
    at ``first_row``.
    """

    native_height: int
    native_width: int
    height: int
    width: int
    first_row: int
    rows: int

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return (rows, width, 3) uint8 of an image (H, W) or (H, W, 3) uint8."""
        colour = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        resized = Image.fromarray(colour).resize((self.width, self.height),
                                                 Image.Resampling.BICUBIC)
        return np.asarray(resized)[self.first_row:self.first_row + self.rows]

    def native_intrinsics(self, K: np.ndarray) -> np.ndarray:
        """Return intrinsics (..., 3, 3) of the native image for those of the fitted one."""
        scale_x, scale_y = self.native_width / self.width, self.native_height / self.height
        to_native = np.array([
            [scale_x, 0.0, 0.0],
            [0.0, scale_y, self.first_row * self.native_height / self.height],
            [0.0, 0.0, 1.0]])
        return to_native @ K


def fit_image(native_height: int, native_width: int, width: int) -> ImageFit:
    """Return the fit of images of one size to `width`, a multiple of PATCH_SIZE [px].

    The height is rounded to whole patches; images higher than wide are cropped to a square.
    Raises KfvoError where less than one row of patches remains, and for extremely high images.
    """
    if native_height > MAX_HEIGHT_TO_WIDTH * native_width:
        raise KfvoError(f'expected images at most {MAX_HEIGHT_TO_WIDTH} times as high as wide; '
                        f'{native_width}x{native_height} came')
    height = round(native_height * (width / native_width) / PATCH_SIZE) * PATCH_SIZE
    if height == 0:
        raise KfvoError(f'expected images at least {PATCH_SIZE} pixels high when {width} wide; '
                        f'{native_width}x{native_height} came')
    rows = min(height, width)
    return ImageFit(native_height, native_width, height, width, (height - rows) // 2, rows)
