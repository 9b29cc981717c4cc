# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""MCAP files: unfinished ones, CRCs, bounded memory, other encodings, every layout."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from bag_writers import PINHOLE, STAMPS_NS, BagBuilder, Records
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.typesys import Stores, get_typestore
from sequence_writers import make_image

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.bag.mcap_records import MAX_BYTES
from kfvo_ros.sequences.bag.reader import Bag, QosOffer

FRAMES = 24
TIMES_NS = [STAMPS_NS[0] + 50_000_000 * index for index in range(FRAMES)]
CHUNK = 2_000
"""Two images of 768 bytes fit, so there are up to three in a chunk."""


def records(writer: BagBuilder) -> Records:
    return [('/image', time_ns, writer.image(time_ns, make_image(index)))
            for index, time_ns in enumerate(TIMES_NS)]


def write_mcap(path: Path, content: Iterable[tuple[str, int, Any]], ros1: bool = False,
               others: Iterable[tuple[str, str, str]] = (), qos: str = '', **options: Any) -> Path:
    """Write messages, and for `others` (topic, message encoding, schema encoding) one each."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    options = {'compression': CompressionType.NONE, 'chunk_size': CHUNK, **options}
    with path.open('wb') as file:
        writer = Writer(file, **options)
        writer.start(profile='ros1' if ros1 else 'ros2')
        for topic, encoding, schema in others:
            schema_id = writer.register_schema('acme.Thing', schema, b'\n\x00')
            channel = writer.register_channel(topic, encoding, schema_id)
            writer.add_message(channel, TIMES_NS[0], b'', TIMES_NS[0])
        channels: dict[str, int] = {}
        for topic, time_ns, message in content:
            kind = message.__msgtype__
            if topic not in channels:
                text = store.generate_msgdef(kind, ros_version=1 if ros1 else 2)[0]
                name = kind.replace('/msg/', '/') if ros1 else kind
                schema_id = writer.register_schema(name, 'ros1msg' if ros1 else 'ros2msg',
                                                   text.encode())
                channels[topic] = writer.register_channel(
                    topic, 'ros1' if ros1 else 'cdr', schema_id, {'offered_qos_profiles': qos})
            data = store.serialize_ros1(message, kind) if ros1 else \
                store.serialize_cdr(message, kind)
            writer.add_message(channels[topic], time_ns, bytes(data), time_ns)
        writer.finish()
    return path


def chunks(path: Path) -> list[tuple[int, int]]:
    """Return (offset, number of images before it) of each chunk."""
    with path.open('rb') as file:
        indexes = make_reader(file).get_summary().chunk_indexes
    counts = [(index.message_index_length - 15) // 16 for index in indexes]
    assert sum(counts) == FRAMES and len(counts) > 6
    return [(index.chunk_start_offset, sum(counts[:number]))
            for number, index in enumerate(indexes)]


def read(path: Path) -> list[int]:
    """Return the indices of the frames, whose images are checked."""
    sequence = open_sequence(str(path), camera=PINHOLE)
    indices = []
    for frame in sequence:
        indices.append(TIMES_NS.index(frame.stamp_ns))
        np.testing.assert_array_equal(frame.image, make_image(indices[-1]))
    return indices


@pytest.mark.parametrize('options', [
    {}, {'compression': CompressionType.ZSTD}, {'compression': CompressionType.LZ4},
    {'use_chunking': False}, {'index_types': IndexType.NONE}, {'use_statistics': False},
    {'repeat_channels': False}, {'repeat_schemas': False}, {'enable_crcs': False},
    {'index_types': IndexType.CHUNK}, {'use_chunking': False, 'use_statistics': False}])
def test_every_layout(options, tmp_path, caplog):
    path = write_mcap(tmp_path / 'walk.mcap', records(BagBuilder('mcap')), **options)
    assert read(path) == list(range(FRAMES)) and not caplog.records
    with Bag(path) as bag:
        assert bag.count('/image') == FRAMES
        assert (bag.start_ns, bag.end_ns) == (TIMES_NS[0], TIMES_NS[-1] + 1)
        assert [time_ns for _, time_ns, _ in bag.raw_messages(
            ['/image'], TIMES_NS[5], TIMES_NS[9])] == TIMES_NS[5:9]


def test_messages_of_overlapping_chunks_come_in_time_order(tmp_path):
    content = records(BagBuilder('mcap'))
    order = np.random.default_rng(0).permutation(FRAMES)
    path = write_mcap(tmp_path / 'walk.mcap', [content[index] for index in order])
    assert read(path) == list(range(FRAMES))


@pytest.mark.parametrize('compression', [CompressionType.NONE, CompressionType.ZSTD])
@pytest.mark.parametrize('whole_chunks', [1, 4, 6])
def test_a_cut_file_is_read_to_its_last_whole_chunk(whole_chunks, compression, tmp_path, caplog):
    path = write_mcap(tmp_path / 'walk.mcap', records(BagBuilder('mcap')),
                      compression=compression)
    offset, count = chunks(path)[whole_chunks]
    path.write_bytes(path.read_bytes()[:offset + 100])
    assert read(path) == list(range(count)) and 0 < count < FRAMES
    warning, = caplog.records
    assert 'it has no end, as when its recording was not finished' in warning.message
    assert f'hold {count} messages' in warning.message


def test_an_unfinished_file_without_chunks(tmp_path, caplog):
    path = write_mcap(tmp_path / 'walk.mcap', records(BagBuilder('mcap')), use_chunking=False)
    path.write_bytes(path.read_bytes()[:8000])
    kept = read(path)
    assert kept == list(range(len(kept))) and 5 < len(kept) < FRAMES
    assert 'it has no end' in caplog.text


def test_a_damaged_index_is_replaced_by_a_scan(tmp_path, caplog):
    path = write_mcap(tmp_path / 'walk.mcap', records(BagBuilder('mcap')))
    data = bytearray(path.read_bytes())
    data[-60] ^= 1  # in the summary, whose CRC the footer has
    path.write_bytes(data)
    assert read(path) == list(range(FRAMES)) and 'its index is damaged (CRC)' in caplog.text


@pytest.mark.parametrize('compression', [CompressionType.NONE, CompressionType.ZSTD])
def test_a_chunk_with_a_wrong_crc_is_left_out(compression, tmp_path, caplog):
    path = write_mcap(tmp_path / 'walk.mcap', records(BagBuilder('mcap')),
                      compression=compression)
    data = bytearray(path.read_bytes())
    (offset, first), (_, end) = chunks(path)[3:5]
    data[offset + 700] ^= 1  # a pixel
    path.write_bytes(data)
    sequence = open_sequence(str(path), camera=PINHOLE)
    lost = end - first
    assert len(list(sequence)) == FRAMES - lost and sequence.left_out == {'missing': lost}
    assert read(path) == [*range(first), *range(end, FRAMES)]
    assert f'found {FRAMES - lost} of the {FRAMES} messages on /image' in caplog.text
    assert 'is damaged' in caplog.text


@pytest.mark.parametrize('announced', [1 << 30, 1000, MAX_BYTES])
def test_a_chunk_that_unpacks_to_a_gigabyte_is_refused(announced, tmp_path):
    """33 kB of zstd; the chunk announces its size, another one, or the largest allowed."""
    path = write_mcap(tmp_path / 'walk.mcap', records(BagBuilder('mcap')))
    compressor = zstandard.ZstdCompressor().compressobj()
    packed = b''.join(compressor.compress(bytes(1 << 24)) for _ in range(64)) + compressor.flush()
    builder = RecordBuilder()
    Chunk('zstd', packed, 2 ** 62, 0, 0, announced).write(builder)
    path.write_bytes(path.read_bytes()[:chunks(path)[0][0]] + builder.end())
    tracemalloc.start()
    with pytest.raises(KfvoError, match=r'topics are: none; the chunk at byte \d+ is damaged'):
        open_sequence(str(path), camera=PINHOLE)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= 2 * MAX_BYTES if announced == MAX_BYTES else peak < 1 << 24


@pytest.mark.parametrize('other', [
    ('/scene', 'protobuf', 'protobuf'), ('/tags', 'json', 'jsonschema'),
    ('/x', 'cdr', 'flatbuffer'), ('/y', 'cdr', 'ros2msg'), ('/image', 'protobuf', 'protobuf')])
def test_other_encodings_are_passed_over(other, tmp_path):
    path = write_mcap(tmp_path / 'walk.mcap', records(BagBuilder('mcap')), others=[other])
    assert read(path) == list(range(FRAMES))
    with Bag(path) as bag:
        assert list(bag.topics) == ['/image'] and list(bag.passed_over) == [other[0]]


def test_a_file_of_other_encodings_names_them(tmp_path):
    path = write_mcap(tmp_path / 'walk.mcap', [], others=[('/scene', 'protobuf', 'protobuf')])
    with pytest.raises(KfvoError, match=r'none; these cannot be decoded: /scene \(protobuf\)'):
        open_sequence(str(path))


def test_messages_of_ros1(tmp_path):
    builder = BagBuilder('ros1')
    info = [('/camera_info', TIMES_NS[0], builder.camera_info(33.0))]
    path = write_mcap(tmp_path / 'walk.mcap', info + records(builder), ros1=True)
    assert read(path) == list(range(FRAMES))
    assert open_sequence(str(path)).camera.fx == 33.0
    with Bag(path) as bag:
        _, _, cdr = next(bag.raw_messages(['/image'], 0, 2 ** 62))
    image = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(cdr, 'sensor_msgs/msg/Image')
    assert image.header.frame_id == 'camera' and image.width == 32


def test_an_unreadable_quality_of_service_costs_nothing_else(tmp_path, caplog):
    path = write_mcap(tmp_path / 'walk.mcap', records(BagBuilder('mcap')), qos='[: no YAML')
    with Bag(path) as bag:
        assert bag.qos_offer('/image') == QosOffer()
    assert read(path) == list(range(FRAMES)) and 'quality of service of /image' in caplog.text


def test_metadata_records_are_found_with_and_without_an_index(tmp_path):
    path = tmp_path / 'walk.mcap'
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start(profile='ros2')
        writer.add_metadata('kfvo_ros/camera', {'readout_s': '0.03'})
        writer.add_metadata('other', {'a': 'b'})
        writer.finish()
    data = path.read_bytes()
    for size in (len(data), len(data) - 8):
        path.write_bytes(data[:size])
        with Bag(path) as bag:
            assert bag.metadata_records('kfvo_ros/camera') == [{'readout_s': '0.03'}]
