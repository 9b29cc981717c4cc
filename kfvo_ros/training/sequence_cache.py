# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cache of encoded sequences by name, in memory and in a folder."""

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
from kfvo_ros.errors import KfvoError
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import SequenceOptions
from kfvo_ros.sequences.base import CALIBRATION_FILE, Sequence
from kfvo_ros.sequences.calibration import read_camera_info
from kfvo_ros.training.augmentation import Augmentation, SequenceVariant
from kfvo_ros.training.encoded_sequence import (
    EncodedSequence,
    encode_sequence,
    read_encoded_sequence,
    write_encoded_sequence,
)
from kfvo_ros.utils.files import user_path

MIN_FRAMES = 20
"""Fewer frames give an episode hardly any decisions."""
MAX_IN_MEMORY = 128
"""Sequences in memory: one of 200 frames with 400 tracks takes 3 MB."""
VariantKey = tuple[str, Augmentation | None, int]
"""Name of a sequence, its augmentation, None for none, and the variant's number."""


@dataclass
class EncodedSequenceCache:
    """Encodes sequences, each once; `settings` of the backbone distinguish files in `folder`.

    Without a `folder` the cache is in memory only. With `keep_images` the frames keep their
    images, to be encoded in the episode, and nothing is cached.
    """

    backbone: Backbone
    sequence_options: SequenceOptions
    settings: dict[str, Any] = field(default_factory=dict)
    folder: Path | None = None
    keep_images: bool = False
    _in_memory: OrderedDict[VariantKey, EncodedSequence] = field(default_factory=OrderedDict)

    def __post_init__(self) -> None:
        gc.unfreeze()  # the frozen sequences of an earlier cache may be garbage by now

    def sequence(self, text: str) -> EncodedSequence:
        """Return a sequence without augmentation; raises KfvoError where it cannot be used."""
        return self._get(text, None, 0)

    def sequences(self, texts: tuple[str, ...]) -> CachedSequences:
        """Return many sequences without augmentation, loaded when they are accessed."""
        return CachedSequences(self, texts)

    def variant(self, text: str, augmentation: Augmentation, number: int) -> EncodedSequence:
        """Return a variant of a sequence; raises KfvoError where it cannot be used."""
        return self._get(text, augmentation, number)

    def _get(self, text: str, augmentation: Augmentation | None, number: int) -> EncodedSequence:
        if self.keep_images:
            return self._encode(text, augmentation, number)
        key: VariantKey = (text, augmentation, number)
        if key not in self._in_memory:
            self._in_memory[key] = self._load(*key)
            if len(self._in_memory) > MAX_IN_MEMORY:
                self._in_memory.popitem(last=False)
            gc.collect()  # garbage would be frozen, too
            gc.freeze()  # thousands of objects without a cycle slow the garbage collector down
        self._in_memory.move_to_end(key)
        return self._in_memory[key]

    def _load(self, text: str, augmentation: Augmentation | None,
              number: int) -> EncodedSequence:
        """Read the sequence from the folder; encode and write one that is not there."""
        if self.folder is None:
            return self._encode(text, augmentation, number)
        path = self.folder / f'{self._file_stem(text, augmentation, number)}.safetensors'
        sequence = read_encoded_sequence(path)
        if sequence is None:
            sequence = self._encode(text, augmentation, number)
            write_encoded_sequence(path, sequence)
        return sequence

    def _encode(self, text: str, augmentation: Augmentation | None,
                number: int) -> EncodedSequence:
        source: Sequence = factory.make_sequence(text, self.sequence_options)
        backbone, stop = None if self.keep_images else self.backbone, self.sequence_options.stop
        if augmentation is None:
            encoded = encode_sequence(source, backbone, stop)
        else:
            encoded = encode_sequence(SequenceVariant(source, augmentation, number, stop),
                                      backbone)
        if len(encoded) < MIN_FRAMES:
            raise KfvoError(f'{source.name}: expected at least {MIN_FRAMES} frames with '
                            f'ground truth to learn from, came {len(encoded)}')
        return encoded

    def _file_stem(self, text: str, augmentation: Augmentation | None, number: int) -> str:
        """Return a file name that changes with the version, the inputs and the settings."""
        path, camera = user_path(text), self.sequence_options.camera
        options = asdict(self.sequence_options) | {
            'camera': camera and asdict(read_camera_info(Path(camera)))}
        identity = {'version': __version__,
                    'text': str(path.resolve()) if path.exists() else text,
                    'files': _files_of(path) if path.exists() else [],
                    'reading': options, 'number': number, 'about': self.settings,
                    'augmentation': augmentation and asdict(augmentation)}
        digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
        return f'{path.name[:32].replace(":", "-")}-{digest[:16]}'


@dataclass(frozen=True)
class CachedSequences(abc.Sequence[EncodedSequence]):
    """Sequences of a cache, each loaded when accessed: not all images at once."""

    cache: EncodedSequenceCache
    texts: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.texts)

    def __getitem__(self, index: Any) -> Any:
        return self.cache.sequence(self.texts[index])


def _files_of(path: Path) -> list[tuple[str, int, int]]:
    """Return name, size and modification time [ns] of all files that a sequence may consist of.

    Outside its own path these are a calibration and the true poses of KITTI.
    """
    path = Path(os.path.abspath(path))
    files = (path, *path.rglob('*'), path.parent / CALIBRATION_FILE,
             path.parent.parent / 'poses' / f'{path.name}.txt')
    return sorted((os.path.relpath(file, path), file.stat().st_size, file.stat().st_mtime_ns)
                  for file in files if file.is_file())
