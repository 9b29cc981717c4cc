# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader of ROS 1 and ROS 2 recordings; every defect is a KfvoError."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.sequences.bag.storage import ZSTD_MAGIC, WarnOnce, open_recording
from kfvo_ros.trajectory import NANOSECONDS

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
TRANSFORMS = frozenset(('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage'))
"""Transform messages by ROS 2 type name; TUM's bags have the type from before tf2."""
_log = logging.getLogger(__name__)


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

    ``topics`` maps each topic with messages to its type; ``passed_over`` maps those that cannot
    be decoded to the reason. Reading a damaged file raises KfvoError; single messages that are
    damaged are left out with a warning.
    """

    topics: dict[str, str]

    def __init__(self, path: Path, warn: WarnOnce | None = None) -> None:
        self.path = path
        self._warn = warn or WarnOnce()
        self._stack = ExitStack()

    def __enter__(self) -> Bag:
        """Read the index; raises KfvoError without a valid one."""
        # Imported here, because the import takes longer than opening a dataset.
        from kfvo_ros.sequences.bag.message_types import MessageTypes
        with _reading_errors(self.path), ExitStack() as stack:
            recording = open_recording(self.path, stack, self._warn)
            self._readers = recording.readers
            self.is_ros1 = all(reader.is_ros1 for reader in self._readers)
            usable = [connection for reader in self._readers for connection in reader.connections
                      if reader.is_ros1 == self.is_ros1]
            self._types = MessageTypes(usable, self.is_ros1, self._warn)
            self.passed_over = {topic: reason for reader in self._readers
                                for topic, reason in reader.passed_over.items()}
            self._connections = self._types.connections
            self.topics = {topic: connections[0].msgtype
                           for topic, connections in self._connections.items()
                           if self._recorded(topic)}
            self._promised = recording.promised
            self._stack = stack.pop_all()
            if self.passed_over:
                _log.info('%s: passed over %s', self.path, self._list_passed_over())
            self.passed_over |= self._types.passed_over
        lost = [topic for topic, count in self._promised.items()
                if count > 0 and topic not in self.topics and topic not in self.passed_over]
        if lost:
            self._warn(f'{self.path}: the files hold no messages on {", ".join(lost)}, which the '
                       'metadata promises')
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        """Close the files."""
        self._stack.close()

    def topics_of_type(self, *types: str) -> list[str]:
        """Return the sorted names of the topics of these message types."""
        return sorted(topic for topic, kind in self.topics.items() if kind in types)

    def find_topic(self, topic: str, types: frozenset[str], purpose: str) -> str:
        """Return a requested topic's name; raises KfvoError naming those of the `types`."""
        name = f'/{topic.lstrip("/")}'
        if self.topics.get(name) not in types:
            names = ', '.join(self.topics_of_type(*types)) or 'none'
            raise KfvoError(f'{self.path}: topic {topic} holds no {purpose}; these do: {names}'
                            f'{self.problems()}')
        return name

    def problems(self) -> str:
        """Return what cannot be read, for the end of an error message."""
        damage = [reader.damage for reader in self._readers if getattr(reader, 'damage', '')]
        if self.passed_over:
            damage.append(f'these cannot be decoded: {self._list_passed_over()}')
        return ''.join(f'; {each}' for each in damage)

    @property
    def start_ns(self) -> int:
        """Bag time [ns] of the earliest message of all topics."""
        return min(int(reader.start_time) for reader in self._readers)

    @property
    def end_ns(self) -> int:
        """Bag time [ns] after the latest message of all topics."""
        return max(int(reader.end_time) for reader in self._readers)

    def count(self, topic: str) -> int:
        """Return the number of messages of a topic, the largest that an index states."""
        return max(self._recorded(topic), self._promised.get(topic, 0))

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield (bag time [ns], message) of a topic in recording order.

        Messages that cannot be decoded are left out with a warning. Raises KfvoError for a type
        whose definition lacks a field.
        """
        self._types.check_fields(self.topics[topic])
        count = damaged = 0
        for connection, bag_time_ns, raw in self._raw(frozenset((topic,))):
            count += 1
            try:
                message = self._types.decode(raw, connection.msgtype)
            except Exception as error:  # rosbags checks little, see `_reading_errors`
                damaged += 1
                if damaged == 1:
                    self._warn(f'{self.path}: a message on {topic} at bag time {bag_time_ns} ns '
                               f'cannot be decoded; such messages are left out: '
                               f'{reason_of(error)}')
                continue
            yield bag_time_ns, message
        if count < self.count(topic):
            self._warn(f'{self.path}: found {count} of the {self.count(topic)} messages on '
                       f'{topic} that the index states')

    def first_message(self, topic: str) -> Any:
        """Return the first message of a topic."""
        for _, message in self.messages(topic):
            return message
        raise self.nothing_readable(topic)

    def nothing_readable(self, topic: str) -> KfvoError:
        """Return the error of a topic whose messages cannot be read."""
        return KfvoError(f'{self.path}: the index promises messages on {topic}, none can be read'
                         f'{self.problems()}')

    def raw_messages(self, topics: Collection[str], start_ns: int,
                     stop_ns: int) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, bag time [ns], CDR) of `start_ns` <= bag time < `stop_ns`, in order.

        The CDR is that of ROS 2 for ROS 1 bags too; headers lose their ``seq``.
        """
        for connection, bag_time_ns, raw in self._raw(topics, start_ns, stop_ns):
            if self.is_ros1:
                with _reading_errors(self.path):
                    store = self._types.ros2_store(connection.msgtype)
                    raw = store.ros1_to_cdr(raw, connection.msgtype)
            yield connection.topic, bag_time_ns, bytes(raw)

    def metadata_records(self, name: str) -> list[dict[str, str]]:
        """Return the MCAP metadata records of this name."""
        return [record for reader in self._readers
                for record in getattr(reader, 'metadata_records', lambda name: [])(name)]

    def _raw(self, topics: Collection[str], start_ns: int | None = None,
             stop_ns: int | None = None) -> Iterator[tuple[Any, int, Any]]:
        """Yield (connection, bag time [ns], data) of the topics, file by file."""
        for reader in self._readers:
            connections = [connection for topic in topics
                           for connection in self._connections.get(topic, ())
                           if connection.owner is reader]
            if not connections:
                continue
            with _reading_errors(self.path):
                for connection, bag_time_ns, raw in reader.messages(connections, start_ns,
                                                                    stop_ns):
                    if connection.topic in topics:
                        yield connection, bag_time_ns, _unpacked(raw)

    def _recorded(self, topic: str) -> int:
        return sum(connection.msgcount for connection in self._connections.get(topic, ()))

    def _list_passed_over(self) -> str:
        return ', '.join(f'{topic} ({reason})' for topic, reason in self.passed_over.items())

    def wire_format(self, kind: str) -> str | None:
        """Return the ROS 2 wire format of a message type, None for one the bag does not define.

        The format lists the primitive types of the fields in order, nested messages in
        parentheses, as in ``(int32 uint32) string uint8[]`` or ``float64[9]``.
        """
        with _reading_errors(self.path):
            store = self._types.ros2_store(kind)
            return None if store is None else _wire_format(store.fielddefs, kind)

    def qos_offer(self, topic: str) -> QosOffer:
        """Return the QoS that matches every subscriber of the recorded publishers.

        That is the strongest of their offers, with the sum of their depths.
        """
        with _reading_errors(self.path):
            offers = [offer for connection in self._connections[topic]
                      for offer in _offers(connection.ext)]
            known = all(offer.depth for offer in offers)
            return QosOffer(any(offer.reliable for offer in offers) or not offers,
                            any(offer.latched for offer in offers),
                            sum(offer.depth for offer in offers) if known else 0)


def message_stamp_ns(header: Any, bag_time_ns: int) -> int:
    """Return a header's stamp [ns], the bag time where the stamp is zero."""
    return header.stamp.sec * NANOSECONDS + header.stamp.nanosec or bag_time_ns


def _unpacked(raw: bytes | memoryview) -> bytes | memoryview:
    """Return a message that rosbag2 compressed on its own, in bounded memory."""
    if bytes(raw[:4]) != ZSTD_MAGIC:  # CDR begins with a zero
        return raw
    from kfvo_ros.sequences.bag.mcap_records import MAX_BYTES, decompress_zstd
    return decompress_zstd(bytes(raw), MAX_BYTES)


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
