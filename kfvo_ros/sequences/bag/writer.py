# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One writer of rosbag2 recordings in MCAP, whose every failure is a KfvoError."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import (
    CompressionFormat,
    CompressionMode,
    StoragePlugin,
    Writer,
    WriterError,
)
from rosbags.typesys import Stores, get_typestore

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.sequences.bag.reader import BAG_SUFFIXES

FOREVER = QosTime(9223372036, 854775807)
"""What rmw calls an infinite duration."""
STREAM = Qos(QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE, FOREVER,
             FOREVER, QosLiveliness.AUTOMATIC, FOREVER, False)
"""Quality of service of what comes again and again: subscribers of either reliability match."""
LATCHED = STREAM._replace(depth=1, durability=QosDurability.TRANSIENT_LOCAL)
"""Quality of service of /tf_static: whoever subscribes late still gets it."""


class Written(NamedTuple):
    """What a topic of the bag holds."""

    message_type: str
    messages: int


class BagWriter:
    """A new recording at ``path``, a folder that the first message creates.

    Chunks are compressed if `zstd`; ROS 2 before Jazzy needs metadata of version 8. Raises
    KfvoError for a path that is taken or cannot be written.
    """

    def __init__(self, path: Path, zstd: bool = False,
                 metadata_version: Literal[8, 9] = 9) -> None:
        if os.path.lexists(path):
            raise KfvoError(f'{path} exists already and nothing is overwritten; choose another '
                            'name')
        if path.suffix in BAG_SUFFIXES:
            raise KfvoError(f'{path}: a recording of ROS 2 is a folder that holds a '
                            f'{path.suffix} file; leave {path.suffix} out of its name')
        self.path = path
        self._writer = Writer(path, version=metadata_version, storage_plugin=StoragePlugin.MCAP)
        if zstd:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Connection] = {}
        self._failure: KfvoError | None = None

    @property
    def topics(self) -> dict[str, Written]:
        """What was written, by topic."""
        return {connection.topic: Written(connection.msgtype, self._writer.counts[connection.id])
                for connection in self._writer.connections}

    def write(self, topic: str, stamp_ns: int, message: Any, qos: Qos = STREAM) -> None:
        """Append a message of rosbags; a topic has the type and the QoS of its first."""
        kind = message.__msgtype__
        data = self._store.serialize_cdr(message, kind)
        with self._told():
            if not self._connections:
                self._writer.open()
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic, kind, typestore=self._store, offered_qos_profiles=[qos])
            self._writer.write(self._connections[topic], stamp_ns, data)

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        with self._told():
            self._writer.close()

    def discard(self) -> None:
        """Delete what was written."""
        if self._connections:
            self._writer.abort()
            shutil.rmtree(self.path, ignore_errors=True)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Turn a failure to write into a KfvoError, then and ever after: the file is torn."""
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except (OSError, WriterError) as error:
            with suppress(OSError):
                self._writer.abort()
            torn = '; what is there is incomplete: delete it, or rescue what "mcap recover" can'
            self._failure = KfvoError(f'cannot write {self.path}: {reason_of(error)}'
                                      f'{torn if self._connections else ""}')
            raise self._failure from error
