# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences with ground truth to drive through again and again, encoded once or each time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import cast

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from kfvo_ros.backbones.base import Backbone, Encoded
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.observations import FrameTracks
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.sequences.base import Frame, Sequence
from kfvo_ros.tracking.tracker import Tracks
from kfvo_ros.trajectory import Trajectory, associate
from kfvo_ros.utils.files import atomic_write

NO_IMAGE = np.zeros((0, 0), dtype=np.uint8)
FILE_KEY = 'kfvo_drive'


@dataclass(frozen=True)
class EncodedSequence:
    """Frames, what the backbone made of each, and where they truly were.

    ``encoded`` never depends on what was kept; those frames have lost their images. It is None
    where a frame has to be encoded when its turn comes. ``T_truth_camera`` (N, 4, 4) [m].
    """

    name: str
    frames: tuple[Frame, ...]
    encoded: tuple[Encoded | None, ...]
    T_truth_camera: np.ndarray

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def truth(self) -> Trajectory:
        """Return where the camera truly was when each frame was taken."""
        stamps_ns = np.array([frame.stamp_ns for frame in self.frames], dtype=np.int64)
        return Trajectory(stamps_ns, self.T_truth_camera)

    def since(self, start: int) -> EncodedSequence:
        """Return the drive without its first frames."""
        return EncodedSequence(self.name, self.frames[start:], self.encoded[start:],
                               self.T_truth_camera[start:])


def encode_sequence(sequence: Sequence, backbone: Backbone | None, stop: int | None = None) -> EncodedSequence:
    """Encode a sequence, or hold its images if there is no `backbone` to do so.

    Frames without ground truth within 10 ms are left out. Raises KfvoError for a sequence whose
    true camera poses are not known.
    """
    truth = true_trajectory(sequence)
    seen = list(_seen(islice(sequence, stop), sequence, backbone))
    stamps_ns = np.array([frame.stamp_ns for frame, _ in seen], dtype=np.int64)
    matched, nearest = associate(stamps_ns, truth.stamps_ns)
    return EncodedSequence(sequence.name, tuple(seen[index][0] for index in matched),
                           tuple(seen[index][1] for index in matched), truth.poses[nearest])


def true_trajectory(sequence: Sequence) -> Trajectory:
    """Return where the camera truly was; raises KfvoError where that is not known."""
    truth = sequence.ground_truth()
    if truth is None or truth.frame != 'camera' or not truth.trajectory.has_rotation:
        came = 'none' if truth is None else f'that of {truth.frame}' + (
            '' if truth.trajectory.has_rotation else ' without rotations')
        raise KfvoError(f'{sequence.name}: expected ground truth of the camera to learn from, '
                        f'{came} came')
    return truth.trajectory


def _seen(frames: Iterator[Frame], sequence: Sequence,
          backbone: Backbone | None) -> Iterator[tuple[Frame, Encoded | None]]:
    """Yield what is kept of each frame."""
    stream = backbone.open(sequence.camera) if backbone is not None else None
    for frame in frames:
        if stream is None:
            yield frame, None
        else:
            yield replace(frame, image=NO_IMAGE), stream.encode(frame)


def write_encoded_sequence(path: Path, drive: EncodedSequence) -> None:
    """Write a drive; whoever reads meanwhile sees all of it or nothing. Raises KfvoError."""
    # This backbone asks for a camera, encodes every frame of a drive and offers tracks.
    camera = cast(Camera, drive.frames[0].camera)
    encoded = cast('tuple[Encoded, ...]', drive.encoded)
    tracks = [cast(Tracks, each.tracks) for each in encoded]
    arrays = {
        'stamps_ns': np.array([frame.stamp_ns for frame in drive.frames], dtype=np.int64),
        'T_truth_camera': drive.T_truth_camera,
        'descriptors': np.stack([each.descriptor for each in encoded]),
        'indices': np.array([each.payload.index for each in encoded], dtype=np.int64),
        'counts': np.array([len(each) for each in tracks], dtype=np.int64),
        'ids': np.concatenate([each.ids for each in tracks]),
        'pixels': np.concatenate([each.pixels for each in tracks]),
        'doubts': np.concatenate([each.doubts for each in tracks]),
        'points': np.concatenate([_points(each.payload, all_of_it)
                                  for each, all_of_it in zip(encoded, tracks, strict=True)])}
    head = {'name': drive.name, 'camera': asdict(camera)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as draft:
            save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()},
                      draft, {FILE_KEY: json.dumps(head)})
    except (OSError, SafetensorError) as error:
        raise KfvoError(f'cannot keep tracks in {path.parent}: {reason_of(error)}') from error


def read_encoded_sequence(path: Path) -> EncodedSequence | None:
    """Read a drive; None where there is no sound one."""
    try:
        with safe_open(path, 'np') as file:
            head = json.loads((file.metadata() or {})[FILE_KEY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        _check(arrays)
        camera = Camera(**head['camera'] | {'distortion': tuple(head['camera']['distortion'])})
        rows = np.cumsum(arrays['counts'])[:-1]
        parts = zip(*(np.split(arrays[name], rows)
                      for name in ('ids', 'pixels', 'doubts', 'points')))
        encoded = [_encoded(*each) for each in zip(arrays['stamps_ns'], arrays['descriptors'],
                                                   arrays['indices'], parts, strict=True)]
        return EncodedSequence(head['name'],
                               tuple(Frame(each.stamp_ns, NO_IMAGE, camera) for each in encoded),
                               tuple(encoded), arrays['T_truth_camera'])
    except Exception:  # of what is no drive whatever comes, and then it is recorded anew
        return None


def _check(arrays: dict[str, np.ndarray]) -> None:
    """Raise ValueError unless the arrays are of as many frames and tracks, and are numbers."""
    frames, tracks = len(arrays['stamps_ns']), int(arrays['counts'].sum())
    shapes = {'stamps_ns': (frames,), 'T_truth_camera': (frames, 4, 4),
              'descriptors': (frames, GeometricBackbone.descriptor_size), 'indices': (frames,),
              'counts': (frames,), 'ids': (tracks,), 'pixels': (tracks, 2), 'doubts': (tracks,),
              'points': (tracks, 2)}
    if {name: array.shape for name, array in arrays.items()} != shapes:
        raise ValueError('other shapes')
    # A point is NaN where its pixel has no ray.
    if not all(np.isfinite(array).all() for name, array in arrays.items() if name != 'points'):
        raise ValueError('not finite')


def _points(view: FrameTracks, tracks: Tracks) -> np.ndarray:
    """Return where the tracks lie undistorted (N, 2), NaN for those that the view has not."""
    points = np.full((len(tracks), 2), np.nan)
    points[np.isin(tracks.ids, view.tracks.ids, assume_unique=True)] = view.points
    return points


def _encoded(stamp_ns: np.int64, descriptor: np.ndarray, index: np.int64,
             parts: tuple[np.ndarray, ...]) -> Encoded:
    *tracked, points = parts
    tracks, usable = Tracks(*tracked), np.isfinite(points).all(axis=1)
    return Encoded(int(stamp_ns), descriptor,
                   FrameTracks(int(index), tracks.select(usable), points[usable]), tracks)
