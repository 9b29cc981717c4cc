# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe-based feed-forward visual odometry for ROS 2.

The public names are imported on first use::

    from kfvo_ros import make_odometry, open_sequence

    odometry = make_odometry()
    for frame in open_sequence('synthetic:0'):
        update = odometry.process(frame)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kfvo_ros.camera import Camera
    from kfvo_ros.errors import KfvoError
    from kfvo_ros.odometry.factory import make_odometry
    from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
    from kfvo_ros.odometry.options import OdometryOptions, VggtOptions
    from kfvo_ros.odometry.updates import FramePose, Update
    from kfvo_ros.sequences import open_sequence
    from kfvo_ros.sequences.base import Frame, Sequence
    from kfvo_ros.trajectory import Trajectory

__version__ = '0.1.0'
__all__ = ['Camera', 'Frame', 'FramePose', 'KeyframeOdometry', 'KfvoError', 'OdometryOptions',
           'Sequence', 'Trajectory', 'Update', 'VggtOptions', 'make_odometry', 'open_sequence']

_MODULES = {
    'Camera': 'camera', 'Frame': 'sequences.base', 'FramePose': 'odometry.updates',
    'KeyframeOdometry': 'odometry.keyframe_odometry', 'KfvoError': 'errors',
    'OdometryOptions': 'odometry.options', 'Sequence': 'sequences.base',
    'Trajectory': 'trajectory', 'Update': 'odometry.updates', 'VggtOptions': 'odometry.options',
    'make_odometry': 'odometry.factory', 'open_sequence': 'sequences'}
"""Modules of the public names; they are imported lazily, since commands answer --help at once."""


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(importlib.import_module(f'{__name__}.{_MODULES[name]}'), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
