# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives by the names of their sequences: recorded once, kept in memory and in a folder."""

from __future__ import annotations

import gc
import hashlib
import json
from collections import OrderedDict
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from kfvo_ros import __version__, assembly
from kfvo_ros.backbones.base import Backbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.learning.augmentation import Augmentation, Variant
from kfvo_ros.learning.drive_file import read_drive, write_drive
from kfvo_ros.learning.drives import Drive, record
from kfvo_ros.options import SequenceOptions
from kfvo_ros.sequences.base import Sequence

LEAST_FRAMES = 20
"""A shorter drive is over before much was decided."""
MOST_HELD = 128
"""So many drives stay in memory: of 200 frames with 400 tracks, one takes 3 MB."""


@dataclass
class Archive:
    """Gives drives; `about` names whatever else they depend on: the backbone and its choices.

    Without a `folder` nothing is kept on disk. With `live` frames keep their images, to be
    encoded when their turn comes, and nothing is kept at all.
    """

    backbone: Backbone
    reading: SequenceOptions
    about: dict[str, Any] = field(default_factory=dict)
    folder: Path | None = None
    live: bool = False
    _held: OrderedDict[str, Drive] = field(default_factory=OrderedDict)

    def whole(self, text: str) -> Drive:
        """Return the sequence as it is; raises KfvoError where it cannot be learned from."""
        return self._drive(text, None, 0)

    def variant(self, text: str, augmentation: Augmentation, number: int) -> Drive:
        """Return one of its variants; raises KfvoError where it cannot be learned from."""
        return self._drive(text, augmentation, number)

    def _drive(self, text: str, augmentation: Augmentation | None, number: int) -> Drive:
        if self.live:
            return self._record(text, augmentation, number)
        key = self._key(text, augmentation, number)
        if key not in self._held:
            path = self.folder / f'{key}.safetensors' if self.folder is not None else None
            drive = read_drive(path) if path is not None else None
            if drive is None:
                drive = self._record(text, augmentation, number)
                if path is not None:
                    write_drive(path, drive)
            self._held[key] = drive
            gc.freeze()  # Thousands of objects, none in a cycle: not to be searched for garbage.
            if len(self._held) > MOST_HELD:
                self._held.popitem(last=False)
        self._held.move_to_end(key)
        return self._held[key]

    def _record(self, text: str, augmentation: Augmentation | None, number: int) -> Drive:
        sequence: Sequence = assembly.make_sequence(text, self.reading)
        backbone, stop = None if self.live else self.backbone, self.reading.stop
        if augmentation is None:
            drive = record(sequence, backbone, stop)
        else:
            drive = record(Variant(sequence, augmentation, number, stop), backbone)
        if len(drive) < LEAST_FRAMES:
            raise KfvoError(f'{sequence.name}: expected at least {LEAST_FRAMES} frames with '
                            f'ground truth to learn from, came {len(drive)}')
        return drive

    def _key(self, text: str, augmentation: Augmentation | None, number: int) -> str:
        """Return a name for the drive that no other has, in this version."""
        path = Path(text).expanduser()
        what = {'version': __version__, 'text': str(path.resolve()) if path.exists() else text,
                'changed_ns': path.stat().st_mtime_ns if path.exists() else 0,
                'reading': asdict(self.reading), 'number': number, 'about': self.about,
                'augmentation': augmentation and asdict(augmentation)}
        digest = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()
        return f'{path.name[:32].replace(":", "-")}-{digest[:16]}'
