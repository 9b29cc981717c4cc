# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""MCAP files as rosbags' readers present bags; finished or not, messages stay serialized."""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from operator import attrgetter, itemgetter
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    Footer,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
)
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys.msg import normalize_msgtype

from kfvo_ros.errors import reason_of
from kfvo_ros.sequences.bag.mcap_records import (
    HEAD,
    MAGIC,
    McapRecords,
    Message,
    Place,
    split_records,
)

FOOTER_BYTES = HEAD.size + 20 + len(MAGIC)
RUN_BYTES = 1 << 20
"""Records outside of chunks are read in runs of about this size."""
FORMATS = {'ros2msg': MessageDefinitionFormat.MSG, 'ros1msg': MessageDefinitionFormat.MSG,
           'ros2idl': MessageDefinitionFormat.IDL, 'omgidl': MessageDefinitionFormat.IDL,
           '': MessageDefinitionFormat.NONE}
"""Format of message definitions by the encoding of a schema."""
END_OF_TIME = 2 ** 63 - 1


@dataclass(frozen=True)
class MessageBlock:
    """A chunk, or a run of records outside of chunks; ``channels`` None means unknown."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None
    is_chunk: bool = True


class McapFile:
    """One MCAP file with the interface of rosbags' readers.

    ``connections`` are those of CDR channels, or of ROS 1 channels in a file without CDR;
    ``is_ros1`` says which; ``passed_over`` maps other topics to their encoding. A file without
    a usable index is scanned, as far as it is whole. A damaged chunk is left out with a warning;
    ``damage`` has the first reason. Raises KfvoError for a file that is no MCAP file.
    """

    def __init__(self, path: Path, warn: Callable[[str], None]) -> None:
        self.path, self._warn = path, warn
        self.connections: list[Connection] = []
        self.passed_over: dict[str, str] = {}
        self.damage = ''
        self.is_ros1 = False

    def open(self) -> None:
        """Read the index, or scan the file."""
        self._records = McapRecords(self.path)
        try:
            self._clear()
            problem = self._read_index()
            if problem is not None:
                self._clear()
                self._scan(problem)
            self._blocks.sort(key=attrgetter('offset'))
            self._make_connections()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._records.close()

    def messages(self, connections: Collection[Connection] = (), start: int | None = None,
                 stop: int | None = None) -> Iterator[tuple[Connection, int, memoryview]]:
        """Yield (connection, log time [ns], data) of `start` <= log time < `stop`, in order."""
        wanted = {connection.id: connection for connection in connections or self.connections}
        first_ns = 0 if start is None else start
        end_ns = END_OF_TIME if stop is None else stop
        streams = [self._block_messages(block, wanted, first_ns, end_ns)
                   for block in self._blocks
                   if block.end_ns >= first_ns and block.start_ns < end_ns
                   and (block.channels is None or not block.channels.isdisjoint(wanted))]
        for time_ns, message in heapq.merge(*streams, key=itemgetter(0)):
            if message is not None:
                yield wanted[message.channel_id], time_ns, message.data

    def metadata_records(self, name: str) -> list[dict[str, str]]:
        """Return the metadata records of this name that can be read."""
        records = []
        for offset in self._metadata_offsets:
            place = self._records.place(offset)
            try:
                record = None if place is None else self._records.parse(place)
            except Exception as error:  # of struct and text
                self._warn(f'{self.path}: a metadata record is damaged: {reason_of(error)}')
                continue
            if isinstance(record, Metadata) and record.name == name:
                records.append(record.metadata)
        return records

    def _clear(self) -> None:
        self.start_time, self.end_time = END_OF_TIME, 0
        self._blocks: list[MessageBlock] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._metadata_offsets: list[int] = []

    def _read_index(self) -> str | None:
        """Read the summary section; return the reason to scan instead, None where it is whole.

        The reason is empty for a file that was written without an index.
        """
        end = self._records.size - FOOTER_BYTES
        footer = self._records.read(end, FOOTER_BYTES)
        if not footer.startswith(HEAD.pack(Opcode.FOOTER, 20)) or not footer.endswith(MAGIC):
            return 'it has no end, as when its recording was not finished'
        try:
            record = self._records.parse(Place(end, Opcode.FOOTER, 20))
            start = record.summary_start if isinstance(record, Footer) else 0
            if start == 0:
                return ''
            summary = self._records.read(start, end - start)
            (crc,) = struct.unpack_from('<I', footer, HEAD.size + 16)
            if crc and zlib.crc32(summary + footer[:HEAD.size + 16]) != crc:
                return 'its index is damaged (CRC)'
            for place in self._records.places(start, end):
                self._take(place)
        except Exception as error:  # of struct and text
            return f'its index is damaged ({reason_of(error)})'
        indexed = frozenset().union(*(block.channels or () for block in self._blocks))
        is_whole = self._blocks and self._counts.total() and \
            indexed <= self._channels.keys() and \
            {channel.schema_id for channel in self._channels.values()} <= {0, *self._schemas}
        return None if is_whole else ''

    def _take(self, place: Place) -> None:
        """Take over a record of the summary section."""
        record = self._records.parse(place)
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, MetadataIndex):
            self._metadata_offsets.append(record.offset)
        elif isinstance(record, Statistics):
            self._counts.update(record.channel_message_counts)
            if record.message_count:
                self._extend_times(record.message_start_time, record.message_end_time)
        elif isinstance(record, ChunkIndex):
            self._blocks.append(MessageBlock(
                record.chunk_start_offset, record.chunk_length, record.message_start_time,
                record.message_end_time, frozenset(record.message_index_offsets) or None))

    def _scan(self, problem: str) -> None:
        """List blocks, channels and counts by reading all records, up to one that is not whole."""
        indexed: Counter[int] = Counter()  # messages of the last chunk by its message index
        chunk: MessageBlock | None = None
        run: list[Place] = []
        end = len(MAGIC)
        for place in self._records.places(end, self._records.size):
            if chunk is not None and place.opcode != Opcode.MESSAGE_INDEX:
                self._add_chunk(chunk, indexed)
                chunk, indexed = None, Counter()
            is_outside = place.opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
            if run and (not is_outside or place.end - run[0].offset > RUN_BYTES):
                self._add_run(run)
                run = []
            if is_outside:
                run.append(place)
            elif place.opcode == Opcode.CHUNK and place.length >= 16:
                start_ns, end_ns = struct.unpack('<QQ', self._records.read(place.content, 16))
                chunk = MessageBlock(place.offset, place.end - place.offset, start_ns, end_ns,
                                     None)
            elif place.opcode == Opcode.MESSAGE_INDEX and place.length >= 6:
                channel, size = struct.unpack('<HI', self._records.read(place.content, 6))
                indexed[channel] += size // 16
            elif place.opcode == Opcode.METADATA:
                self._metadata_offsets.append(place.offset)
            end = place.end
            if place.opcode == Opcode.DATA_END:
                break
        if chunk is not None:
            self._add_chunk(chunk, indexed)
        if run:
            self._add_run(run)
        if problem:
            self._warn(f'{self.path}: {problem}; its whole chunks hold {self._counts.total()} '
                       f'messages, in {end} of {self._records.size} bytes')

    def _add_chunk(self, chunk: MessageBlock, indexed: Counter[int]) -> None:
        """Add a chunk; it is unpacked where the index after it does not say what is in it."""
        if not indexed or not indexed.keys() <= self._channels.keys():
            indexed = Counter(message.channel_id for message in self._unpack(chunk))
        self._counts.update(indexed)
        if indexed:
            self._extend_times(chunk.start_ns, chunk.end_ns)
            self._blocks.append(replace(chunk, channels=frozenset(indexed)))

    def _add_run(self, run: list[Place]) -> None:
        """Add the messages outside of chunks, and learn their channels."""
        block = MessageBlock(run[0].offset, run[-1].end - run[0].offset, 0, 0, None,
                             is_chunk=False)
        messages = self._unpack(block)
        self._counts.update(message.channel_id for message in messages)
        if messages:
            times = [message.log_time for message in messages]
            self._extend_times(min(times), max(times))
            self._blocks.append(replace(
                block, start_ns=min(times), end_ns=max(times),
                channels=frozenset(message.channel_id for message in messages)))

    def _extend_times(self, first_ns: int, last_ns: int) -> None:
        self.start_time = min(self.start_time, first_ns)
        self.end_time = max(self.end_time, last_ns + 1)

    def _make_connections(self) -> None:
        """Make the connections of the channels that can be decoded."""
        encodings = {channel.message_encoding for channel in self._channels.values()}
        self.is_ros1 = 'ros1' in encodings and 'cdr' not in encodings
        encoding = 'ros1' if self.is_ros1 else 'cdr'
        for channel in self._channels.values():
            schema = self._schemas.get(channel.schema_id)
            if channel.message_encoding != encoding or schema is None:
                self.passed_over[channel.topic] = channel.message_encoding or 'no encoding'
            elif schema.encoding not in FORMATS:
                self.passed_over[channel.topic] = f'schema of {schema.encoding}'
            else:
                definition = MessageDefinition(FORMATS[schema.encoding],
                                               schema.data.decode(errors='replace'))
                self.connections.append(Connection(
                    channel.id, channel.topic, normalize_msgtype(schema.name), definition, '',
                    self._counts[channel.id],
                    ConnectionExtRosbag2(encoding, self._parse_offers(channel)), self))

    def _block_messages(self, block: MessageBlock, wanted: Collection[int], start_ns: int,
                        stop_ns: int) -> Iterator[tuple[int, Message | None]]:
        """Yield the time of a block before it is read, then its messages in time order."""
        yield block.start_ns, None
        messages = [message for message in self._unpack(block) if message.channel_id in wanted
                    and start_ns <= message.log_time < stop_ns]
        for message in sorted(messages, key=attrgetter('log_time')):
            yield message.log_time, message

    def _unpack(self, block: MessageBlock) -> list[Message]:
        """Return the messages of a block, none of a damaged one; learn its channels."""
        try:
            data = self._records.unpack_chunk(block.offset) if block.is_chunk else \
                self._records.unpack_run(block.offset, block.length)
            records = list(split_records(data))
        except Exception as error:  # of zstd, lz4, struct, text and memory
            if not self.damage:
                self.damage = f'the chunk at byte {block.offset} is damaged: {reason_of(error)}'
                self._warn(f'{self.path}: {self.damage}; the messages of such chunks are left out')
            return []
        for record in records:
            if isinstance(record, Schema):
                self._schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                self._channels.setdefault(record.id, record)
        return [record for record in records if isinstance(record, Message)]

    def _parse_offers(self, channel: Channel) -> list[Qos]:
        """Return the recorded quality of service of a channel's publishers."""
        try:
            return parse_qos(channel.metadata.get('offered_qos_profiles', ''))
        except Exception as error:  # YAML of any kind
            self._warn(f'{self.path}: the quality of service of {channel.topic} cannot be read: '
                       f'{reason_of(error)}')
            return []
