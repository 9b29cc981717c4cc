# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader of ROS 1 and ROS 2 recordings; every defect is a KfvoError."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.trajectory import NANOSECONDS

BAG_SUFFIXES = frozenset(('.bag', '.mcap', '.db3'))
IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
TRANSFORMS = frozenset(('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage'))
"""Transform messages by ROS 2 type name; TUM's bags have the type from before tf2."""
HEADER = 'std_msgs/msg/Header'


@dataclass(frozen=True)
class QosOffer:
    """Quality of service that the publishers of a topic offered.

    ``latched`` (transient local): late subscribers received the last ``depth`` messages. A depth
    of 0 means not recorded.
    """

    reliable: bool = True
    latched: bool = False
    depth: int = 0


class Bag:
    """A recording, open within a ``with`` statement; messages are read lazily.

    ``topics`` maps each topic with messages to its type. Reading a damaged file raises
    KfvoError.
    """

    topics: dict[str, str]

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_ros1 = path.suffix == '.bag'

    def __enter__(self) -> Bag:
        """Read the index; raises KfvoError without a valid one."""
        # Imported here, because the import takes longer than opening a dataset.
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        if not self.path.exists():
            raise KfvoError(f'{self.path} does not exist; expected a bag')
        with _reading_errors(self.path):
            # The default type store is for bags before ROS 2 Iron, without message definitions.
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

    def topics_of_type(self, *types: str) -> list[str]:
        """Return the sorted names of the topics of these message types."""
        return sorted(topic for topic, kind in self.topics.items() if kind in types)

    def find_topic(self, topic: str, types: frozenset[str], purpose: str) -> str:
        """Return a requested topic's name; raises KfvoError naming those of the `types`."""
        name = f'/{topic.lstrip("/")}'
        if self.topics.get(name) not in types:
            names = ', '.join(self.topics_of_type(*types)) or 'none'
            raise KfvoError(f'{self.path}: topic {topic} holds no {purpose}; these do: {names}')
        return name

    def image_topics(self) -> list[str]:
        """Return the sorted names of the image topics, depth images last."""
        return sorted(self.topics_of_type(IMAGE, COMPRESSED_IMAGE),
                      key=lambda name: ('depth' in name, name))

    @property
    def start_ns(self) -> int:
        """Bag time [ns] of the earliest message of all topics."""
        return self._reader.start_time

    @property
    def end_ns(self) -> int:
        """Bag time [ns] after the latest message of all topics."""
        return self._reader.end_time

    def count(self, topic: str) -> int:
        """Return the number of messages of a topic."""
        return self._reader.topics[topic].msgcount

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield (bag time [ns], message) of a topic in recording order."""
        connections = [connection for connection in self._reader.connections
                       if connection.topic == topic]
        with _reading_errors(self.path):
            for connection, bag_time_ns, raw in self._reader.messages(connections):
                yield bag_time_ns, self._reader.deserialize(raw, connection.msgtype)

    def first_message(self, topic: str) -> Any:
        """Return the first message of a topic."""
        for _, message in self.messages(topic):
            return message
        raise KfvoError(f'{self.path}: the index promises messages on {topic}, there are none')

    def raw_messages(self, topics: Collection[str], start_ns: int,
                     stop_ns: int) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, bag time [ns], CDR) of `start_ns` <= bag time < `stop_ns`, in order.

        The CDR is that of ROS 2 for ROS 1 bags too; headers lose their ``seq``.
        """
        connections = [connection for connection in self._reader.connections
                       if connection.topic in topics]
        with _reading_errors(self.path):
            for connection, bag_time_ns, raw in self._reader.messages(connections, start_ns,
                                                                      stop_ns):
                if self.is_ros1:
                    raw = self._ros2_types.ros1_to_cdr(raw, connection.msgtype)
                yield connection.topic, bag_time_ns, bytes(raw)

    def wire_format(self, kind: str) -> str | None:
        """Return the ROS 2 wire format of a message type, None for one the bag does not define.

        The format lists the primitive types of the fields in order, nested messages in
        parentheses, as in ``(int32 uint32) string uint8[]`` or ``float64[9]``.
        """
        with _reading_errors(self.path):
            return _wire_format(self._ros2_types.fielddefs, kind)

    def qos_offer(self, topic: str) -> QosOffer:
        """Return the QoS that matches every subscriber of the recorded publishers.

        That is the strongest of their offers, with the sum of their depths.
        """
        with _reading_errors(self.path):
            offers = [offer for connection in self._reader.topics[topic].connections
                      for offer in _offers(connection.ext)]
            known = all(offer.depth for offer in offers)
            return QosOffer(any(offer.reliable for offer in offers) or not offers,
                            any(offer.latched for offer in offers),
                            sum(offer.depth for offer in offers) if known else 0)

    @cached_property
    def _ros2_types(self) -> Any:
        """The message types in ROS 2: as recorded, except for the header of ROS 1."""
        from rosbags.typesys import Stores, get_typestore
        recorded = self._reader.typestore
        if not self.is_ros1:
            return recorded
        header = get_typestore(Stores.ROS2_JAZZY).fielddefs[HEADER]
        types = get_typestore(Stores.EMPTY)
        types.register(recorded.fielddefs | {HEADER: header})
        return types


def message_stamp_ns(header: Any, bag_time_ns: int) -> int:
    """Return a header's stamp [ns], the bag time where the stamp is zero."""
    return header.stamp.sec * NANOSECONDS + header.stamp.nanosec or bag_time_ns


def _wire_format(definitions: Any, kind: str) -> str | None:
    """Return the wire format of a type by rosbags' definitions, see `Bag.wire_format`."""
    from rosbags.interfaces import Nodetype

    def describe(field: Any) -> str:
        """Return the type of a field in the syntax of message definitions."""
        node, content = field
        if node == Nodetype.BASE:
            return 'uint8' if content[0] == 'char' else content[0]
        if node == Nodetype.NAME:
            return f'({_wire_format(definitions, content)})'
        element, count = content
        return f'{describe(element)}[{count if node == Nodetype.ARRAY else ""}]'

    if kind not in definitions:
        return None
    return ' '.join(describe(field) for name, field in definitions[kind][1]
                    if name != 'structure_needs_at_least_one_member')


def _offers(recorded: Any) -> list[QosOffer]:
    """Return the offers of a connection's publishers, from rosbags' record of ROS 1 or 2."""
    from rosbags.interfaces import (
        ConnectionExtRosbag1,
        QosDurability,
        QosHistory,
        QosReliability,
    )
    if isinstance(recorded, ConnectionExtRosbag1):
        return [QosOffer(latched=bool(recorded.latching), depth=1 if recorded.latching else 0)]
    return [QosOffer(qos.reliability is not QosReliability.BEST_EFFORT,
                     qos.durability is QosDurability.TRANSIENT_LOCAL,
                     max(int(qos.depth), 0) if qos.history is QosHistory.KEEP_LAST else 0)
            for qos in recorded.offered_qos_profiles]


@contextmanager
def _reading_errors(path: Path) -> Iterator[None]:
    """Turn any error of reading a damaged file into a KfvoError.

    All exceptions are caught because rosbags checks little: a truncated or overwritten file
    raises its own errors, but also struct, codec, key, assertion and SQLite errors.
    """
    try:
        yield
    except KfvoError:
        raise
    except Exception as error:
        raise KfvoError(f'cannot read the bag {path}: {reason_of(error)}; is it complete? '
                        'Recover it with "ros2 bag reindex", "mcap recover" or "rosbag reindex"'
                        ) from error
