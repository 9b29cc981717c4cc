# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rendered sequences, ``synthetic:SEED[:STYLE]``, with exact poses and depths."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cached_property
from itertools import islice

import numpy as np

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Frame, GroundTruth, Sequence
from kfvo_ros.sequences.synthetic.motion import FRAME_RATES_HZ, ClosedSpline, SineSum, camera_poses
from kfvo_ros.sequences.synthetic.renderer import render
from kfvo_ros.sequences.synthetic.rng import StableRng
from kfvo_ros.sequences.synthetic.room import build_room, room_loop
from kfvo_ros.sequences.synthetic.scene import Scene
from kfvo_ros.sequences.synthetic.shading import simulate_sensor
from kfvo_ros.sequences.synthetic.street import build_street, street_loop
from kfvo_ros.trajectory import NANOSECONDS, Trajectory

STYLES = ('smooth', 'fast', 'mixed', 'street')
MAX_SEED = 2 ** 32 - 1
START_NS = NANOSECONDS
"""The first stamp; in ROS a stamp of zero means that there is none."""
FOCAL_PER_WIDTH = 400.0 / 640.0
GAIN_DRIFT, GAIN_BANDS_HZ = 0.05, ((0.05, 0.1), (0.1, 0.2), (0.2, 0.4))
"""Drift of the camera's gain: one sine of this amplitude per band."""
RNG_PURPOSES = ('room', 'path', 'motion', 'scene', 'gain')
"""The index is part of the random number key: the order is part of the published bytes."""


class SyntheticSequence(Sequence):
    """A rendered room or street in grey values; frames are rendered on demand.

    In a room the camera is hand-held, 30 Hz: ``smooth`` and ``fast`` are easy; ``mixed`` also
    hovers, creeps and turns on the spot, and with odd seeds it moves abruptly in a room of low
    contrast. In a ``street`` the camera is on a car, 10 Hz, that drives at changing speed, stops
    and takes corners. World z is up and the first pose is not the identity. The same arguments
    give the same bytes on every machine; a longer sequence starts with the frames of a shorter
    one. Raises KfvoError for arguments out of range.
    """

    def __init__(self, seed: int, style: str = 'mixed', frame_count: int = 200,
                 width: int = 640, height: int = 480) -> None:
        if not 0 <= seed <= MAX_SEED or style not in STYLES \
                or min(frame_count, width, height) < 1:
            raise KfvoError(
                f'expected a seed of 0 to {MAX_SEED}, a style of {", ".join(STYLES)} and '
                f'positive sizes; came seed {seed}, style {style!r}, {frame_count} frames of '
                f'{width}x{height}')
        self.name = f'synthetic:{seed}:{style}'
        focal = FOCAL_PER_WIDTH * width
        self.camera: Camera = Camera(width, height, focal, focal, 0.5 * (width - 1),
                                     0.5 * (height - 1))
        self._seed, self._length = seed, frame_count
        self._style_index = STYLES.index(style)
        self._style = 'hectic' if style == 'mixed' and seed % 2 else style

    @property
    def length(self) -> int:
        """Number of frames."""
        return self._length

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order."""
        return (self.frame(index) for index in range(self._length))

    def frame(self, index: int) -> Frame:
        """Render a frame; raises IndexError."""
        index = range(self._length)[index]
        radiance, _ = render(self._scene, self.camera, self._poses[index])
        gain = 1.0 + GAIN_DRIFT * self._gain.at(index)
        image = simulate_sensor(radiance, gain, noise_key=self._seed << 32 | index)
        return Frame(self._stamp_ns(index), image, self.camera)

    def depth(self, index: int) -> np.ndarray:
        """Return a frame's depth (H, W) along the optical axis [m]; raises IndexError."""
        return render(self._scene, self.camera, self._poses[index])[1]

    def ground_truth(self) -> GroundTruth:
        """Return the rendered poses, T_world_camera."""
        stamps_ns = np.array([self._stamp_ns(index) for index in range(self._length)],
                             dtype=np.int64)
        return GroundTruth(Trajectory(stamps_ns, self._poses))

    @cached_property
    def _poses(self) -> np.ndarray:
        poses = camera_poses(self._rng('motion'), self._style, self._path)
        return np.stack(list(islice(poses, self._length)))

    @cached_property
    def _scene(self) -> Scene:
        if self._style == 'street':
            return build_street(self._rng('scene'), self._path)
        return build_room(self._rng('scene'), self._style, self._room_size,
                          self._path.sample(600))

    @cached_property
    def _gain(self) -> SineSum:
        return SineSum(self._rng('gain'), FRAME_RATES_HZ[self._style], *GAIN_BANDS_HZ)

    @property
    def _path(self) -> ClosedSpline:
        rng = self._rng('path')
        if self._style == 'street':
            return street_loop(rng)
        return room_loop(rng, self._room_size)

    @property
    def _room_size(self) -> tuple[float, float, float]:
        rng = self._rng('room')
        return rng.between(6.5, 9.5), rng.between(6.0, 8.0), rng.between(2.6, 3.2)

    def _stamp_ns(self, index: int) -> int:
        return START_NS + index * NANOSECONDS // FRAME_RATES_HZ[self._style]

    def _rng(self, purpose: str) -> StableRng:
        return StableRng(self._seed, self._style_index, RNG_PURPOSES.index(purpose))


def parse_synthetic(text: str) -> SyntheticSequence:
    """Return the sequence of ``synthetic:SEED[:STYLE]``; raises KfvoError for anything else."""
    match = re.fullmatch(r'synthetic:([0-9]{1,10})(?::([a-z]+))?', text)
    if match is None:
        raise KfvoError('expected synthetic:SEED or synthetic:SEED:STYLE, as in '
                        f'synthetic:7:fast, came {text!r}')
    return SyntheticSequence(int(match[1]), match[2] or 'mixed')
