# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images as the model was trained on: a fixed width, whole patches, Pillow's bicubic filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image

from kfvo_ros.backbones.vggt.config import PATCH
from kfvo_ros.errors import KfvoError

MOST_HIGH = 16
"""What is higher is no picture, and would be made enormous before it is cut."""


@dataclass(frozen=True)
class Fit:
    """How images of one size are brought to the model's, by the official loader's ``crop`` rule.

    Resized to (``height``, ``width``), then the middle ``rows`` are kept, from ``first`` on.
    """

    native_height: int
    native_width: int
    height: int
    width: int
    first: int
    rows: int

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return (rows, width, 3) uint8 of an image (H, W) or (H, W, 3) uint8."""
        colour = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        resized = Image.fromarray(colour).resize((self.width, self.height),
                                                 Image.Resampling.BICUBIC)
        return np.asarray(resized)[self.first:self.first + self.rows]

    def native(self, K: np.ndarray) -> np.ndarray:
        """Return intrinsics (..., 3, 3) of the native image for those of the fitted one."""
        to_native = np.array([
            [self.native_width / self.width, 0.0, 0.0],
            [0.0, self.native_height / self.height, self.first * self.native_height / self.height],
            [0.0, 0.0, 1.0]])
        return to_native @ K


def fit(native_height: int, native_width: int, width: int) -> Fit:
    """Return how images of one size are brought to `width`, a multiple of PATCH [px].

    The height is rounded to whole patches; what is higher than wide is cut to a square. Raises
    KfvoError when not one row of patches is left, and for what is far higher than wide.
    """
    if native_height > MOST_HIGH * native_width:
        raise KfvoError(f'expected images at most {MOST_HIGH} times as high as wide; '
                        f'{native_width}x{native_height} came')
    height = round(native_height * (width / native_width) / PATCH) * PATCH
    if height == 0:
        raise KfvoError(f'expected images at least {PATCH} pixels high when {width} wide; '
                        f'{native_width}x{native_height} came')
    rows = min(height, width)
    return Fit(native_height, native_width, height, width, (height - rows) // 2, rows)
