# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images that show nothing, by the name of their kind."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_LEVELS = {'black': 0.0, 'grey': 120.0, 'saturated': 255.0}
_Maker = Callable[[tuple[int, int], np.random.Generator], np.ndarray]


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Return grey values as uint8."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def blind_image(kind: str, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return an image (H, W) uint8 of one of KINDS."""
    return _MAKERS[kind](shape, rng)


def _flat(level: float, sigma: float) -> _Maker:
    return lambda shape, rng: to_bytes(level + sigma * rng.normal(size=shape))


def _covered(level: float, sigma: float) -> _Maker:
    """Return a maker of a dark lens cap with vignetting."""
    def make(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
        y, x = np.mgrid[:shape[0], :shape[1]]
        radius = np.hypot(0.75 * (y / shape[0] - 0.5), x / shape[1] - 0.5)
        return to_bytes(level / (1.0 + radius ** 2) ** 2 + sigma * rng.normal(size=shape))
    return make


def _hot_pixels(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return a black image with bright pixels, the same ones in every image of a shape."""
    image = 2.0 + rng.normal(size=shape)
    pixels = np.random.default_rng(0).choice(image.size, image.size // 2000, replace=False)
    image.ravel()[pixels] = 150.0
    return to_bytes(image)


def _rows(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    return to_bytes(10.0 + 2.0 * rng.normal(size=shape) + 2.0 * rng.normal(size=(shape[0], 1)))


_MAKERS: dict[str, _Maker] = {
    **{f'{name}, noise {sigma}': _flat(level, sigma)
       for name, level in _LEVELS.items() for sigma in (0, 1, 2, 3, 5)},
    **{f'cover {level}, noise {sigma}': _covered(level, sigma)
       for level, sigma in ((20, 0), (20, 1), (40, 0.3), (40, 2), (30, 5))},
    'uniform noise': lambda shape, rng: rng.integers(0, 256, shape, dtype=np.uint8),
    'photons': lambda shape, rng: to_bytes(rng.poisson(1.5, shape)),
    'hot pixels': _hot_pixels,
    'noise of rows': _rows}
KINDS = tuple(_MAKERS)
