# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences with ground truth for training: their frames, encodings and true poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import cast

import numpy as np
from safetensors import SafetensorError

from kfvo_ros.backbones.base import Backbone, Encoded
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.observations import FrameTracks
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.sequences.base import Frame, Sequence
from kfvo_ros.tracking.tracker import Tracks
from kfvo_ros.trajectory import Trajectory, associate
from kfvo_ros.utils.tensor_files import read_tensors, write_tensors

NO_IMAGE = np.zeros((0, 0), dtype=np.uint8)
FILE_KEY = 'kfvo_drive'


@dataclass(frozen=True)
class EncodedSequence:
    """Frames, their encodings and true poses ``T_truth_camera`` (N, 4, 4) [m].

    Encodings do not depend on keyframe decisions, so one serves all episodes. Encoded frames
    have no image; frames that are encoded in the episode have None in ``encoded``.
    """

    name: str
    frames: tuple[Frame, ...]
    encoded: tuple[Encoded | None, ...]
    T_truth_camera: np.ndarray

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def truth(self) -> Trajectory:
        """The true pose of each frame."""
        stamps_ns = np.array([frame.stamp_ns for frame in self.frames], dtype=np.int64)
        return Trajectory(stamps_ns, self.T_truth_camera)

    def from_frame(self, start: int) -> EncodedSequence:
        """Return the sequence without its first `start` frames."""
        return EncodedSequence(self.name, self.frames[start:], self.encoded[start:],
                               self.T_truth_camera[start:])


def encode_sequence(sequence: Sequence, backbone: Backbone | None,
                    stop: int | None = None) -> EncodedSequence:
    """Encode the first `stop` frames of a sequence; without a `backbone` keep their images.

    Frames without ground truth within 10 ms are left out. Raises KfvoError for a sequence
    without true camera poses.
    """
    truth = true_trajectory(sequence)
    pairs = list(_encode(islice(sequence, stop), sequence, backbone))
    stamps_ns = np.array([frame.stamp_ns for frame, _ in pairs], dtype=np.int64)
    matched, nearest = associate(stamps_ns, truth.stamps_ns)
    return EncodedSequence(sequence.name, tuple(pairs[index][0] for index in matched),
                           tuple(pairs[index][1] for index in matched), truth.poses[nearest])


def true_trajectory(sequence: Sequence) -> Trajectory:
    """Return the true camera poses; raises KfvoError for a sequence without."""
    truth = sequence.ground_truth()
    if truth is None or truth.frame != 'camera' or not truth.trajectory.has_rotation:
        came = 'none' if truth is None else f'that of {truth.frame}' + (
            '' if truth.trajectory.has_rotation else ' without rotations')
        raise KfvoError(f'{sequence.name}: expected ground truth of the camera to learn from, '
                        f'{came} came')
    return truth.trajectory


def _encode(frames: Iterator[Frame], sequence: Sequence,
            backbone: Backbone | None) -> Iterator[tuple[Frame, Encoded | None]]:
    """Yield each frame without its image, and its encoding; with its image if not encoded."""
    stream = backbone.open(sequence.camera) if backbone is not None else None
    for frame in frames:
        if stream is None:
            yield frame, None
        else:
            yield replace(frame, image=NO_IMAGE), stream.encode(frame)


def write_encoded_sequence(path: Path, sequence: EncodedSequence) -> None:
    """Write a sequence encoded by the geometric backbone, atomically; raises KfvoError."""
    # The geometric backbone requires a camera and offers tracks; all frames are encoded.
    camera = cast(Camera, sequence.frames[0].camera)
    encoded = cast('tuple[Encoded, ...]', sequence.encoded)
    tracks = [cast(Tracks, each.tracks) for each in encoded]
    arrays = {
        'stamps_ns': np.array([frame.stamp_ns for frame in sequence.frames], dtype=np.int64),
        'T_truth_camera': sequence.T_truth_camera,
        'descriptors': np.stack([each.descriptor for each in encoded]),
        'indices': np.array([each.payload.index for each in encoded], dtype=np.int64),
        'counts': np.array([len(each) for each in tracks], dtype=np.int64),
        'ids': np.concatenate([each.ids for each in tracks]),
        'pixels': np.concatenate([each.pixels for each in tracks]),
        'doubts': np.concatenate([each.uncertainty for each in tracks]),
        'points': np.concatenate([_undistorted_points(each.payload, frame_tracks)
                                  for each, frame_tracks in zip(encoded, tracks, strict=True)])}
    metadata = {'name': sequence.name, 'camera': asdict(camera)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_tensors(path, FILE_KEY, metadata, arrays)
    except (OSError, SafetensorError) as error:
        raise KfvoError(f'cannot keep tracks in {path.parent}: {reason_of(error)}') from error


def read_encoded_sequence(path: Path) -> EncodedSequence | None:
    """Read a sequence; return None for a missing or damaged file."""
    try:
        metadata, arrays = read_tensors(path, FILE_KEY)
        _check_arrays(arrays)
        camera = Camera(**metadata['camera']
                        | {'distortion': tuple(metadata['camera']['distortion'])})
        rows = np.cumsum(arrays['counts'])[:-1]
        tracked = zip(*(np.split(arrays[name], rows)
                        for name in ('ids', 'pixels', 'doubts', 'points')))
        encoded = [_encoded_frame(*each)
                   for each in zip(arrays['stamps_ns'], arrays['descriptors'], arrays['indices'],
                                   tracked, strict=True)]
        return EncodedSequence(metadata['name'],
                               tuple(Frame(each.stamp_ns, NO_IMAGE, camera) for each in encoded),
                               tuple(encoded), arrays['T_truth_camera'])
    except Exception:  # a damaged file may raise anything; the sequence is then encoded again
        return None


def _check_arrays(arrays: dict[str, np.ndarray]) -> None:
    """Raise ValueError unless the shapes match and the numbers are finite."""
    frames, tracks = len(arrays['stamps_ns']), int(arrays['counts'].sum())
    shapes = {'stamps_ns': (frames,), 'T_truth_camera': (frames, 4, 4),
              'descriptors': (frames, GeometricBackbone.descriptor_size), 'indices': (frames,),
              'counts': (frames,), 'ids': (tracks,), 'pixels': (tracks, 2), 'doubts': (tracks,),
              'points': (tracks, 2)}
    if {name: array.shape for name, array in arrays.items()} != shapes:
        raise ValueError('unexpected shapes')
    # A point is NaN where its pixel has no ray.
    if not all(np.isfinite(array).all() for name, array in arrays.items() if name != 'points'):
        raise ValueError('not finite')


def _undistorted_points(observed: FrameTracks, tracks: Tracks) -> np.ndarray:
    """Return the undistorted points (N, 2) of all tracks, NaN for those not in `observed`."""
    points = np.full((len(tracks), 2), np.nan)
    points[np.isin(tracks.ids, observed.tracks.ids, assume_unique=True)] = observed.points
    return points


def _encoded_frame(stamp_ns: np.int64, descriptor: np.ndarray, index: np.int64,
                   tracked: tuple[np.ndarray, ...]) -> Encoded:
    *columns, points = tracked
    tracks, usable = Tracks(*columns), np.isfinite(points).all(axis=1)
    frame_tracks = FrameTracks(int(index), tracks.select(usable), points[usable])
    return Encoded(int(stamp_ns), descriptor, frame_tracks, tracks, frame_tracks.blind)
