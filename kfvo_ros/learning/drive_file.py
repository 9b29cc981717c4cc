# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives of the geometric backbone on disk: tracking a variant again would tell nothing new."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from kfvo_ros.atomic import replaced
from kfvo_ros.backbones.base import Encoded
from kfvo_ros.backbones.geometric.observations import View
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.learning.drives import NO_IMAGE, Drive
from kfvo_ros.sequences.base import Frame
from kfvo_ros.tracking import Tracks

KEY = 'kfvo_drive'


def write_drive(path: Path, drive: Drive) -> None:
    """Write a drive; whoever reads meanwhile sees all of it or nothing. Raises KfvoError."""
    encoded = [each for each in drive.encoded if each is not None]
    tracks = [each.tracks or Tracks() for each in encoded]
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
    camera = drive.frames[0].camera
    head = {'name': drive.name, 'camera': None if camera is None else asdict(camera)}
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
        camera = Camera(**head['camera'] | {'distortion': tuple(head['camera']['distortion'])})
        rows = np.cumsum(arrays['counts'])[:-1]
        parts = zip(*(np.split(arrays[name], rows)
                      for name in ('ids', 'pixels', 'doubts', 'points')))
        encoded = [_encoded(*each) for each in zip(arrays['stamps_ns'], arrays['descriptors'],
                                                   arrays['indices'], parts, strict=True)]
        return Drive(head['name'],
                     tuple(Frame(each.stamp_ns, NO_IMAGE, camera) for each in encoded),
                     tuple(encoded), arrays['T_truth_camera'])
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        return None


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
