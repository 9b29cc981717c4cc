# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writer of rosbag2 recordings in MCAP with CRCs; every failure is a KfvoError."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import mcap.writer
from mcap.writer import CompressionType
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
from kfvo_ros.sequences.bag.storage import BAG_SUFFIXES

INFINITE = QosTime(9223372036, 854775807)
"""rmw's infinite duration."""
STREAM = Qos(QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE, INFINITE,
             INFINITE, QosLiveliness.AUTOMATIC, INFINITE, False)
"""Quality of service of periodic topics; subscribers of either reliability match."""
LATCHED = STREAM._replace(depth=1, durability=QosDurability.TRANSIENT_LOCAL)
"""Quality of service of /tf_static: late subscribers receive the last message."""


class McapStorage:
    """The MCAP file of a recording, in the form that rosbags' writer of recordings wants."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        self.path = path / f'{path.name}.mcap'
        self._file = self.path.open('xb')
        self._writer = mcap.writer.Writer(self._file, compression=(
            CompressionType.ZSTD if compression == CompressionMode.STORAGE
            else CompressionType.NONE))
        self._writer.start(profile='ros2')
        self._schemas: dict[str, int] = {}
        self._channels: dict[int, int] = {}

    def add_msgtype(self, connection: Connection) -> None:
        """Write the message definition of a connection."""
        self._schemas[connection.msgtype] = self._writer.register_schema(
            connection.msgtype, 'ros2msg', connection.msgdef.data.encode())

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Write a channel."""
        self._channels[connection.id] = self._writer.register_channel(
            connection.topic, 'cdr', self._schemas[connection.msgtype],
            {'offered_qos_profiles': offered_qos_profiles})

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        """Write a message."""
        self._writer.add_message(self._channels[connection.id], log_time=timestamp,
                                 publish_time=timestamp, data=bytes(data))

    def add_metadata(self, name: str, content: dict[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, content)

    def close(self, version: int, metadata: str) -> None:
        """Write the metadata of the recording and the index."""
        self.add_metadata('rosbag2', {'serialized_metadata': metadata})
        self._writer.finish()
        self._file.close()

    def abort(self) -> None:
        """Close the file as it is."""
        self._file.close()


class RosbagWriter(Writer):
    """rosbags' writer of recordings with our MCAP file."""

    STORAGE_PLUGINS = {StoragePlugin.MCAP: McapStorage}


class TopicInfo(NamedTuple):
    """Type and number of the messages of one topic."""

    message_type: str
    message_count: int


class BagWriter:
    """A new recording at ``path``, a folder that the first message creates.

    `zstd` compresses the chunks. ROS 2 before Jazzy needs metadata of version 8. Raises
    KfvoError for a path that exists or cannot be written.
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
        self._writer = RosbagWriter(path, version=metadata_version,
                                    storage_plugin=StoragePlugin.MCAP)
        if zstd:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Connection] = {}
        self._failure: KfvoError | None = None

    @property
    def topics(self) -> dict[str, TopicInfo]:
        """Message type and count of the written topics."""
        return {connection.topic: TopicInfo(connection.msgtype,
                                            self._writer.counts[connection.id])
                for connection in self._writer.connections}

    def write(self, topic: str, stamp_ns: int, message: Any, qos: Qos = STREAM) -> None:
        """Append a rosbags message; the first one decides the type and QoS of its topic."""
        kind = message.__msgtype__
        data = self._store.serialize_cdr(message, kind)
        with self._writing_errors():
            if not self._connections:
                self._writer.open()
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic, kind, typestore=self._store, offered_qos_profiles=[qos])
            self._writer.write(self._connections[topic], stamp_ns, data)

    def add_metadata(self, name: str, content: dict[str, str]) -> None:
        """Write an MCAP metadata record, after a message."""
        with self._writing_errors():
            storage = self._writer.storage
            assert isinstance(storage, McapStorage)
            storage.add_metadata(name, content)

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        with self._writing_errors():
            self._writer.close()

    def discard(self) -> None:
        """Delete the recording."""
        if self._connections:
            self._writer.abort()
            shutil.rmtree(self.path, ignore_errors=True)

    @contextmanager
    def _writing_errors(self) -> Iterator[None]:
        """Turn a failure to write into a KfvoError; later writes raise it again."""
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except (OSError, WriterError) as error:
            with suppress(OSError):
                self._writer.abort()
            advice = '; the bag is incomplete: delete it, or recover it with "mcap recover"'
            self._failure = KfvoError(f'cannot write {self.path}: {reason_of(error)}'
                                      f'{advice if self._connections else ""}')
            raise self._failure from error
