# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Records of an MCAP file, read at any place: whole ones only, with CRCs and bounded memory.

Format: https://mcap.dev/spec. The records are those of the mcap package.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from kfvo_ros.errors import KfvoError

MAGIC = b'\x89MCAP0\r\n'
HEAD = struct.Struct('<BQ')
"""Opcode and length in front of every record."""
MESSAGE = struct.Struct('<HIQQ')
"""Channel, sequence number, log time and publish time in front of a message."""
MAX_BYTES = 256 << 20
"""Largest chunk that is unpacked: recorders write 1 to 16 MB, a large image more."""
KINDS: dict[int, Any] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.STATISTICS: Statistics, Opcode.METADATA: Metadata,
    Opcode.METADATA_INDEX: MetadataIndex, Opcode.FOOTER: Footer}
"""Records that are parsed whole."""


class Place(NamedTuple):
    """Where a record lies in the file, and what kind it is."""

    offset: int
    opcode: int
    length: int

    @property
    def content(self) -> int:
        """Offset of the content."""
        return self.offset + HEAD.size

    @property
    def end(self) -> int:
        """Offset of the next record."""
        return self.content + self.length


class McapRecords:
    """Access to the records of an open file; ``size`` is its length [bytes].

    Raises KfvoError for a file that does not begin as MCAP.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open('rb')
        self.size = self._file.seek(0, 2)
        if self.read(0, len(MAGIC)) != MAGIC:
            self.close()
            raise KfvoError(f'cannot read the bag {path}: expected an MCAP file, it does not '
                            'begin as one')

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes; none before or after the file."""
        if not 0 <= offset <= self.size:
            return b''
        self._file.seek(offset)
        return self._file.read(max(min(size, self.size - offset), 0))

    def places(self, start: int, end: int) -> Iterator[Place]:
        """Yield the records from `start` on, as long as they lie whole before `end`."""
        offset = start
        while (place := self.place(offset)) is not None and place.end <= end:
            yield place
            offset = place.end

    def place(self, offset: int) -> Place | None:
        """Return the record at `offset`, None where none is whole."""
        head = self.read(offset, HEAD.size)
        if len(head) < HEAD.size:
            return None
        place = Place(offset, *HEAD.unpack(head))
        return place if place.opcode and place.end <= self.size else None

    def parse(self, place: Place) -> McapRecord | None:
        """Return a record, None for one that is not of KINDS; raises KfvoError if too large."""
        if place.opcode not in KINDS:
            return None
        if place.length > MAX_BYTES:
            raise KfvoError(f'a record of {place.length} bytes, expected at most {MAX_BYTES}')
        content = self.read(place.content, place.length)
        record: McapRecord = KINDS[place.opcode].read(ReadDataStream(BytesIO(content)))
        return record

    def unpack_chunk(self, offset: int) -> memoryview:
        """Return the records of a chunk, for `split_records`.

        Raises KfvoError for a chunk that is too large, of another size than announced or with
        another CRC, and the errors of struct and the compressions for one that is damaged.
        """
        place = self.place(offset)
        if place is None or place.opcode != Opcode.CHUNK or place.length > MAX_BYTES:
            raise KfvoError(f'expected a chunk of at most {MAX_BYTES} bytes')
        self._file.seek(place.content)
        chunk = Chunk.read(ReadDataStream(self._file))
        data = _decompress(chunk)
        if len(chunk.data) > place.length or len(data) != chunk.uncompressed_size:
            raise KfvoError(f'expected {chunk.uncompressed_size} bytes when unpacked, came '
                            f'{len(data)}')
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise KfvoError('wrong CRC')
        return memoryview(data)

    def unpack_run(self, offset: int, size: int) -> memoryview:
        """Return records that lie outside of chunks, for `split_records`."""
        return memoryview(self.read(offset, min(size, MAX_BYTES)))


class Message(NamedTuple):
    """A message of a chunk; ``data`` is serialized."""

    channel_id: int
    log_time: int
    data: memoryview


def split_records(data: memoryview) -> Iterator[Message | Schema | Channel]:
    """Yield the messages, schemas and channels of a chunk; struct.error where they do not fit."""
    end = 0
    while end < len(data):
        opcode, length = HEAD.unpack_from(data, end)
        start = end + HEAD.size
        end = start + length
        if end > len(data):
            raise KfvoError('a record that is longer than its chunk')
        if opcode == Opcode.MESSAGE:
            channel_id, _, log_time, _ = MESSAGE.unpack_from(data, start)
            yield Message(channel_id, log_time, data[start + MESSAGE.size:end])
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield KINDS[opcode].read(ReadDataStream(BytesIO(data[start:end])))


def decompress_zstd(data: bytes, size: int) -> bytes:
    """Return up to `size` bytes of a zstd frame, whatever the frame announces."""
    if zstandard.frame_content_size(data) <= size:  # -1 where it is not announced
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    with zstandard.ZstdDecompressor().stream_reader(BytesIO(data)) as stream:
        return stream.read(size)


def _decompress(chunk: Chunk) -> bytes:
    """Return the records of a chunk, one byte too many where they are more than announced."""
    size = chunk.uncompressed_size
    if size > MAX_BYTES:
        raise KfvoError(f'{size} bytes when unpacked, expected at most {MAX_BYTES}')
    if chunk.compression == 'zstd':
        return decompress_zstd(chunk.data, size + 1)
    if chunk.compression == 'lz4':
        unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data,
                                                                      max_length=size + 1)
        return unpacked
    if chunk.compression == '':
        return chunk.data
    raise KfvoError(f'unknown compression {chunk.compression!r}')
