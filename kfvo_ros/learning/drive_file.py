# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives of the geometric backbone on disk: tracking a variant again would tell nothing new."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import cast

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from kfvo_ros.atomic import replaced
from kfvo_ros.backbones.base import Encoded
from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.backbones.geometric.observations import View
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.learning.drives import NO_IMAGE, Drive
from kfvo_ros.sequences.base import Frame
from kfvo_ros.tracking import Tracks

KEY = 'kfvo_drive'


def write_drive(path: Path, drive: Drive) -> None:
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
        with replaced(path) as draft:
            save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()},
                      draft, {KEY: json.dumps(head)})
    except (OSError, SafetensorError) as error:
        raise KfvoError(f'cannot keep tracks in {path.parent}: {reason_of(error)}') from error


def read_drive(path: Path) -> Drive | None:
    """Read a drive; None where there is no sound one."""
    try:
        with safe_open(path, 'np') as file:
            head = json.loads((file.metadata() or {})[KEY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        _check(arrays)
        camera = Camera(**head['camera'] | {'distortion': tuple(head['camera']['distortion'])})
        rows = np.cumsum(arrays['counts'])[:-1]
        parts = zip(*(np.split(arrays[name], rows)
                      for name in ('ids', 'pixels', 'doubts', 'points')))
        encoded = [_encoded(*each) for each in zip(arrays['stamps_ns'], arrays['descriptors'],
                                                   arrays['indices'], parts, strict=True)]
        return Drive(head['name'],
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


def _points(view: View, tracks: Tracks) -> np.ndarray:
    """Return where the tracks lie undistorted (N, 2), NaN for those that the view has not."""
    points = np.full((len(tracks), 2), np.nan)
    points[np.isin(tracks.ids, view.tracks.ids, assume_unique=True)] = view.points
    return points


def _encoded(stamp_ns: np.int64, descriptor: np.ndarray, index: np.int64,
             parts: tuple[np.ndarray, ...]) -> Encoded:
    *tracked, points = parts
    tracks, usable = Tracks(*tracked), np.isfinite(points).all(axis=1)
    return Encoded(int(stamp_ns), descriptor,
                   View(int(index), tracks.select(usable), points[usable]), tracks)
