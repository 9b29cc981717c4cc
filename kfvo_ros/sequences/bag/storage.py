# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a recording: what they are by their content, and readers for them."""

from __future__ import annotations

import logging
import tempfile
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.utils.files import read_yaml

METADATA_FILE = 'metadata.yaml'
BAG_SUFFIXES = frozenset(('.bag', '.mcap', '.db3'))
STORAGE_SUFFIXES = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')
"""Names of the files in a rosbag2 folder, in the order of preference."""
MAGICS = {b'\x89MCAP0\r\n': '.mcap', b'SQLite format 3\0': '.db3', b'#ROSBAG V': '.bag'}
"""How the files begin."""
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
_log = logging.getLogger(__name__)


class WarnOnce:
    """Logs each warning once, however often a recording is opened."""

    def __init__(self) -> None:
        self._said: set[str] = set()

    def __call__(self, text: str) -> None:
        """Log a text as a warning unless it was logged."""
        if text not in self._said:
            self._said.add(text)
            _log.warning('%s', text)


@dataclass
class Recording:
    """Open readers of a recording's files, in order; rosbags defines their interface.

    ``promised`` are the numbers of messages by topic that metadata.yaml states.
    """

    readers: list[Any]
    promised: dict[str, int] = field(default_factory=dict)


def bag_kind(path: Path) -> str | None:
    """Return the suffix that fits the content of a file, None for none of BAG_SUFFIXES.

    The name decides for a file that begins as none of them: it is empty or damaged.
    """
    start = b''
    with suppress(OSError):
        if path.is_file():
            with path.open('rb') as file:
                start = file.read(16)
    for magic, suffix in MAGICS.items():
        if start.startswith(magic):
            return suffix
    return path.suffix if path.suffix in BAG_SUFFIXES else None


def storage_files(folder: Path) -> list[Path]:
    """Return the storage files in a rosbag2 folder by their names, of one suffix only."""
    try:
        names = sorted((path for path in folder.iterdir() if path.is_file()),
                       key=lambda path: (len(path.name), path.name))
    except OSError:
        names = []
    for suffix in STORAGE_SUFFIXES:
        if files := [path for path in names if path.name.endswith(suffix)]:
            return files
    return []


def open_recording(path: Path, stack: ExitStack, warn: WarnOnce) -> Recording:
    """Open the files of a recording; `stack` closes them.

    Raises KfvoError for a path without a bag, and the errors of rosbags for damaged files.
    """
    if path.is_file():
        return Recording(_open_files([path], stack, warn))
    if not path.is_dir():
        problem = 'is neither file nor folder' if path.exists() else 'does not exist'
        raise KfvoError(f'{path} {problem}; expected a bag')
    metadata, problem = _read_metadata(path / METADATA_FILE)
    listed = metadata.get('relative_file_paths')
    files = [path / PurePath(str(name)).name for name in listed] \
        if isinstance(listed, list) else []
    missing = [file.name for file in files if not file.is_file()]
    if missing and not problem:
        problem = f'{", ".join(missing)} of {METADATA_FILE} are missing'
    files = [file for file in files if file.is_file()] or storage_files(path)
    if not files:
        raise KfvoError(f'cannot read the bag {path}: {problem or "it is empty"}; expected '
                        f'{METADATA_FILE} and the .mcap or .db3 files that it lists')
    if problem:
        warn(f'{path}: {problem}; reading {", ".join(file.name for file in files)}')
    return Recording(_open_files(files, stack, warn), _promised_counts(metadata))


def _read_metadata(path: Path) -> tuple[dict[str, Any], str]:
    """Return the bag information in metadata.yaml, and why there is none."""
    if not path.is_file():
        return {}, f'there is no {METADATA_FILE}, as when the recording was not finished'
    try:
        metadata = read_yaml(path)['rosbag2_bagfile_information']
        return (metadata, '') if isinstance(metadata, dict) else \
            ({}, f'{METADATA_FILE} is not that of a bag')
    except KfvoError as error:
        return {}, str(error)
    except (TypeError, KeyError):
        return {}, f'{METADATA_FILE} is not that of a bag'


def _promised_counts(metadata: dict[str, Any]) -> dict[str, int]:
    """Return the numbers of messages by topic, without entries of another form."""
    counts: dict[str, int] = {}
    entries = metadata.get('topics_with_message_count')
    for entry in entries if isinstance(entries, list) else ():
        try:
            name, count = entry['topic_metadata']['name'], entry['message_count']
        except (TypeError, KeyError):
            continue
        if isinstance(name, str) and isinstance(count, int):
            counts[name] = counts.get(name, 0) + count
    return counts


def _open_files(files: list[Path], stack: ExitStack, warn: WarnOnce) -> list[Any]:
    """Return open readers; of several files those that are damaged are left out."""
    readers = []
    for path in files:
        try:
            reader = _make_reader(path, stack, warn)
            reader.open()
        except Exception as error:
            if len(files) == 1:
                raise
            warn(f'{path} is left out: {reason_of(error)}')
            continue
        stack.callback(reader.close)
        readers.append(reader)
    if not readers:
        raise KfvoError(f'none of {", ".join(path.name for path in files)} can be read')
    return readers


def _make_reader(path: Path, stack: ExitStack, warn: WarnOnce) -> Any:
    """Return the reader for the content of a file, which is unpacked first where necessary."""
    with path.open('rb') as file:
        start = file.read(len(ZSTD_MAGIC))
    if start == b'':
        raise KfvoError(f'cannot read the bag {path}: the file is empty')
    if start == ZSTD_MAGIC:
        path = _unpack_file(path, stack)
    # Imported here, because the import takes longer than opening a dataset.
    from kfvo_ros.sequences.bag.mcap_file import McapFile
    from kfvo_ros.sequences.bag.rosbags_files import DatabaseFile, Ros1File
    kind = bag_kind(path)
    if kind == '.mcap':
        return McapFile(path, warn)
    if kind is None:
        raise KfvoError(f'cannot read the bag {path}: it begins neither as a ROS 1 bag nor as '
                        'MCAP or SQLite')
    return DatabaseFile(path) if kind == '.db3' else Ros1File(path)


def _unpack_file(path: Path, stack: ExitStack) -> Path:
    """Return an unpacked copy of a file that rosbag2 compressed as a whole."""
    import zstandard
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    unpacked = folder / path.stem
    with path.open('rb') as packed, unpacked.open('wb') as copy:
        zstandard.ZstdDecompressor().copy_stream(packed, copy)
    return unpacked
