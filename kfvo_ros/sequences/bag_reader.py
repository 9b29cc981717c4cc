# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One reader for the recordings of ROS 1 and ROS 2, whose every defect is a KfvoError."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from kfvo_ros.errors import KfvoError
from kfvo_ros.trajectory import NANOSECONDS

BAG_SUFFIXES = frozenset(('.bag', '.mcap', '.db3'))

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
TRANSFORMS = frozenset(('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage'))
"""Message types by their ROS 2 names; TUM's bags have the transforms of ROS before tf2."""


class Bag:
    """A recording, open between ``with`` and its end; messages are read as they are asked for.

    ``topics`` maps each topic that holds messages to its type.
    """

    topics: dict[str, str]

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_ros1 = path.suffix == '.bag'

    def __enter__(self) -> Bag:
        """Read the index; KfvoError when there is none."""
        # Imported here, because it takes longer than opening a dataset does.
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        with _told(self.path):
            # The default serves bags before ROS 2 Iron, which hold no message definitions.
            self._reader = AnyReader([self.path],
                                     default_typestore=get_typestore(Stores.ROS2_JAZZY))
            self._reader.open()
            self.topics = {topic: info.msgtype for topic, info in self._reader.topics.items()
                           if info.msgtype is not None and info.msgcount > 0}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        """Close the files."""
        self._reader.close()

    def of_type(self, *types: str) -> list[str]:
        """Return the names, sorted, of the topics of these types."""
        return sorted(topic for topic, kind in self.topics.items() if kind in types)

    def find(self, topic: str, types: frozenset[str], purpose: str) -> str:
        """Return the name of a topic the user asked for, or tell which ones would do."""
        name = f'/{topic.lstrip("/")}'
        if self.topics.get(name) not in types:
            names = ', '.join(self.of_type(*types)) or 'none'
            raise KfvoError(f'{self.path}: topic {topic} holds no {purpose}; these do: {names}')
        return name

    def count(self, topic: str) -> int:
        """Return the number of messages of a topic."""
        return self._reader.topics[topic].msgcount

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield (bag time [ns], message) of a topic in the order of recording."""
        connections = [connection for connection in self._reader.connections
                       if connection.topic == topic]
        with _told(self.path):
            for connection, bag_time_ns, raw in self._reader.messages(connections):
                yield bag_time_ns, self._reader.deserialize(raw, connection.msgtype)

    def first(self, topic: str) -> Any:
        """Return the first message of a topic that holds some."""
        for _, message in self.messages(topic):
            return message
        raise KfvoError(f'{self.path}: the index promises messages on {topic}, there are none')


def stamp_of(header: Any, bag_time_ns: int) -> int:
    """Return a header's stamp [ns]; the time of recording where the sender left it zero."""
    return header.stamp.sec * NANOSECONDS + header.stamp.nanosec or bag_time_ns


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Turn whatever reading a damaged file raises into a KfvoError.

    Everything is caught because rosbags checks little: a truncated or overwritten file ends in
    its own errors, but also in struct, codec, key, assertion and SQLite errors.
    """
    try:
        yield
    except KfvoError:
        raise
    except Exception as error:
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise KfvoError(f'cannot read the bag {path}: {reason}; is it complete? Recover it with '
                        '"ros2 bag reindex", "mcap recover" or "rosbag reindex"') from error
