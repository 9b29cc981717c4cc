# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags and SQLite files: the readers of rosbags, bounded and with one interface."""

from __future__ import annotations

import bz2
from typing import Any

import lz4.frame
from rosbags import rosbag1
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.mcap_records import MAX_BYTES


def _decompress(decompressor: Any, data: bytes) -> bytes:
    unpacked: bytes = decompressor.decompress(data, max_length=MAX_BYTES + 1)
    if len(unpacked) > MAX_BYTES:
        raise KfvoError(f'a chunk is larger than {MAX_BYTES} bytes when unpacked')
    return unpacked


BOUNDED = {decompressors['bz2']: lambda data: _decompress(bz2.BZ2Decompressor(), data),
           decompressors['lz4']: lambda data: _decompress(lz4.frame.LZ4FrameDecompressor(), data)}
"""The decompressors of rosbags, and those that use limited memory."""


class Ros1File(rosbag1.Reader):
    """A ROS 1 bag; raises the errors of rosbags."""

    is_ros1 = True

    def open(self) -> None:
        """Read the index."""
        super().open()
        self.passed_over: dict[str, str] = {}
        self.chunks = {
            place: chunk._replace(decompressor=BOUNDED.get(chunk.decompressor,
                                                           chunk.decompressor))
            for place, chunk in self.chunks.items()}


class DatabaseFile(Sqlite3Reader):
    """A SQLite file of rosbag2; topics that are not CDR are passed over."""

    is_ros1 = False

    def open(self) -> None:
        """Read the index."""
        super().open()
        formats = {connection.topic: getattr(connection.ext, 'serialization_format', '')
                   for connection in self.connections}
        self.passed_over = {topic: name for topic, name in formats.items() if name != 'cdr'}
        self.connections = [connection for connection in self.connections
                            if connection.topic not in self.passed_over]

    @property
    def start_time(self) -> int:
        """Time of the earliest message [ns]."""
        return self.metadata.start_time

    @property
    def end_time(self) -> int:
        """Time after the latest message [ns]."""
        return self.metadata.end_time
