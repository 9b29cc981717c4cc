# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which calibration a sequence has: the user's, the file beside it, its own, or a guess."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kfvo_ros.camera import Camera, guess_camera, read_camera_info
from kfvo_ros.errors import KfvoError

CALIBRATION_FILE = 'camera_info.yaml'

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Calibration:
    """Where the camera of a sequence may come from, in order of precedence.

    ``given`` by the user; CALIBRATION_FILE in ``folder``; ``own(width, height)``, what the
    dataset itself says, asked only when the first two are absent.
    """

    given: Camera | None
    folder: Path
    own: Callable[[int, int], Camera | None] = lambda width, height: None

    def camera(self, name: str, width: int, height: int) -> Camera:
        """Return the camera of images of this size; a guess is logged as a warning.

        Raises KfvoError naming the sequence when a calibration is broken or of another shape.
        """
        beside = self.folder / CALIBRATION_FILE
        if self.given is not None:
            camera = self.given
        elif beside.is_file():
            camera = read_camera_info(beside)
        else:
            camera = self.own(width, height) or _guess(name, width, height)
        try:
            return camera.scaled(width, height)
        except KfvoError as error:
            raise KfvoError(f'{name}: {error}') from error


def rigid_transform(numbers: object, what: str) -> np.ndarray:
    """Return T (4, 4) of 16 numbers in rows; KfvoError when they are no rigid transform."""
    try:
        transform = np.array(numbers, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        transform = np.zeros((4, 4))
    rotation = transform[:3, :3]
    if not (np.isfinite(transform).all() and np.allclose(transform[3], (0, 0, 0, 1))
            and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
            and np.linalg.det(rotation) > 0):
        found = ' '.join(str(numbers).split())
        raise KfvoError(f'{what}: expected a rigid 4x4 transform (a rotation, a translation, and '
                        f'0 0 0 1 below), found {found[:200]}')
    return transform


def _guess(name: str, width: int, height: int) -> Camera:
    camera = guess_camera(width, height)
    _log.warning('%s has no calibration: guessing fx = fy = %.0f px for its %dx%d images, which '
                 'bends the trajectory where it is wrong; give a %s in its folder or --camera',
                 name, camera.fx, width, height, CALIBRATION_FILE)
    return camera
