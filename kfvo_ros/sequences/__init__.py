# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences of frames: datasets, bags, folders, videos and rendered scenes, read alike."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import euroc, image_folder, kitti, tartanair, tum, video
from kfvo_ros.sequences.bag import sequence
from kfvo_ros.sequences.base import Sequence, SequenceSettings

SYNTHETIC = 'synthetic'
KINDS = {module.KIND.name: module.KIND
         for module in (euroc, tum, kitti, tartanair, sequence, image_folder, video)}
"""Kinds that are paths, in the order in which they are tried."""


def open_sequence(text: str, *, kind: str | None = None, camera: Camera | None = None,
                  image_topic: str | None = None, ground_truth_topic: str | None = None,
                  ground_truth_to_camera: np.ndarray | None = None,
                  rate: float = 10.0) -> Sequence:
    """Open a path or ``synthetic:SEED[:STYLE]``; its kind is detected unless `kind` forces it.

    `camera` wins over every other calibration; `ground_truth_to_camera` is T_body_camera (4, 4)
    of a bag's ground truth; `rate` [Hz] stamps what has no stamps. Raises KfvoError when the
    path is nothing known, and whatever its kind has to say.
    """
    if kind is not None and kind not in (*KINDS, SYNTHETIC):
        raise KfvoError(f'unknown kind of sequence {kind!r}; expected one of '
                        f'{", ".join((*KINDS, SYNTHETIC))}')
    if kind == SYNTHETIC or (kind is None and text.startswith(f'{SYNTHETIC}:')):
        from kfvo_ros.sequences.synthetic.sequence import parse_synthetic
        return parse_synthetic(text)
    # Absolute, for names like that of '.', but through links: their name may say more.
    path = Path(os.path.abspath(os.path.expanduser(text)))
    options = SequenceSettings(camera, image_topic, ground_truth_topic, ground_truth_to_camera, rate)
    return KINDS[kind or _detect(path)].open(path, options)


def _detect(path: Path) -> str:
    """Return the name of the first kind that knows the path, or tell how each kind looks."""
    for kind in KINDS.values():
        if kind.matches(path):
            return kind.name
    looks = '; '.join(kind.looks_like for kind in KINDS.values())
    problem = 'is no sequence that is known' if path.exists() else 'does not exist'
    raise KfvoError(f'{path} {problem}; expected {looks}; or '
                    f'{SYNTHETIC}:SEED[:smooth|fast|mixed|street]')
