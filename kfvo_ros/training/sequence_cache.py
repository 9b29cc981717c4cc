# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives by the names of their sequences: recorded once, kept in memory and in a folder."""

from __future__ import annotations

import gc
import hashlib
import json
import os
from collections import OrderedDict, abc
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from kfvo_ros import __version__
from kfvo_ros.backbones.base import Backbone
from kfvo_ros.camera import read_camera_info
from kfvo_ros.errors import KfvoError
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import SequenceOptions
from kfvo_ros.sequences.base import CALIBRATION_FILE, Sequence
from kfvo_ros.training.augmentation import Augmentation, SequenceVariant
from kfvo_ros.training.encoded_sequence import (
    EncodedSequence,
    encode_sequence,
    read_encoded_sequence,
    write_encoded_sequence,
)

LEAST_FRAMES = 20
"""A shorter drive is over before much was decided."""
MOST_HELD = 128
"""So many drives stay in memory: of 200 frames with 400 tracks, one takes 3 MB."""


@dataclass
class EncodedSequenceCache:
    """Gives drives; `about` names whatever else they depend on: the backbone and its choices.

    Without a `folder` nothing is kept on disk. With `live` frames keep their images, to be
    encoded when their turn comes, and nothing is kept at all.
    """

    backbone: Backbone
    reading: SequenceOptions
    about: dict[str, Any] = field(default_factory=dict)
    folder: Path | None = None
    live: bool = False
    _held: OrderedDict[tuple[str, Augmentation | None, int], EncodedSequence] = field(
        default_factory=OrderedDict)

    def __post_init__(self) -> None:
        gc.unfreeze()  # What froze along with an earlier archive's drives may be garbage by now.

    def whole(self, text: str) -> EncodedSequence:
        """Return the sequence as it is; raises KfvoError where it cannot be learned from."""
        return self._drive(text, None, 0)

    def wholes(self, texts: tuple[str, ...]) -> CachedSequences:
        """Return many sequences as they are."""
        return CachedSequences(self, texts)

    def variant(self, text: str, augmentation: Augmentation, number: int) -> EncodedSequence:
        """Return one of its variants; raises KfvoError where it cannot be learned from."""
        return self._drive(text, augmentation, number)

    def _drive(self, text: str, augmentation: Augmentation | None, number: int) -> EncodedSequence:
        if self.live:
            return self._record(text, augmentation, number)
        asked = (text, augmentation, number)
        if asked not in self._held:
            self._held[asked] = self._recall(*asked)
            if len(self._held) > MOST_HELD:
                self._held.popitem(last=False)
            gc.collect()  # What is garbage already would stay for ever.
            gc.freeze()  # Thousands of objects, none in a cycle: not to be searched for garbage.
        self._held.move_to_end(asked)
        return self._held[asked]

    def _recall(self, text: str, augmentation: Augmentation | None, number: int) -> EncodedSequence:
        """Return the drive from the folder; record it where it is not there."""
        if self.folder is None:
            return self._record(text, augmentation, number)
        path = self.folder / f'{self._key(text, augmentation, number)}.safetensors'
        drive = read_encoded_sequence(path)
        if drive is None:
            drive = self._record(text, augmentation, number)
            write_encoded_sequence(path, drive)
        return drive

    def _record(self, text: str, augmentation: Augmentation | None, number: int) -> EncodedSequence:
        sequence: Sequence = factory.make_sequence(text, self.reading)
        backbone, stop = None if self.live else self.backbone, self.reading.stop
        if augmentation is None:
            drive = encode_sequence(sequence, backbone, stop)
        else:
            drive = encode_sequence(SequenceVariant(sequence, augmentation, number, stop), backbone)
        if len(drive) < LEAST_FRAMES:
            raise KfvoError(f'{sequence.name}: expected at least {LEAST_FRAMES} frames with '
                            f'ground truth to learn from, came {len(drive)}')
        return drive

    def _key(self, text: str, augmentation: Augmentation | None, number: int) -> str:
        """Return a name for the drive that no other has, in this version."""
        path, camera = Path(text).expanduser(), self.reading.camera
        reading = asdict(self.reading) | {
            'camera': camera and asdict(read_camera_info(Path(camera)))}
        what = {'version': __version__, 'text': str(path.resolve()) if path.exists() else text,
                'files': _files_of(path) if path.exists() else [],
                'reading': reading, 'number': number, 'about': self.about,
                'augmentation': augmentation and asdict(augmentation)}
        digest = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()
        return f'{path.name[:32].replace(":", "-")}-{digest[:16]}'


@dataclass(frozen=True)
class CachedSequences(abc.Sequence[EncodedSequence]):
    """Sequences of an archive, each asked for when its turn comes: not all images at once."""

    archive: EncodedSequenceCache
    texts: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.texts)

    def __getitem__(self, index: Any) -> Any:
        return self.archive.whole(self.texts[index])


def _files_of(path: Path) -> list[tuple[str, int, int]]:
    """Return name, size and time of change [ns] of all files that a sequence may be read from.

    Beside its own path that is a calibration, and the true poses of KITTI.
    """
    path = Path(os.path.abspath(path))
    files = (path, *path.rglob('*'), path.parent / CALIBRATION_FILE,
             path.parent.parent / 'poses' / f'{path.name}.txt')
    return sorted((os.path.relpath(file, path), file.stat().st_size, file.stat().st_mtime_ns)
                  for file in files if file.is_file())
