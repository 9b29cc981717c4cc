# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a recording: kind by content, missing metadata, split and compressed files."""

from __future__ import annotations

import os
import shutil
import sqlite3
from pathlib import Path

import pytest
import yaml
import zstandard
from bag_writers import COUNT, LATER_NS, PINHOLE, STAMPS_NS, STORAGES, BagBuilder, images
from rosbags import rosbag2
from sequence_writers import make_image, write_image

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.bag.reader import Bag

every_storage = pytest.mark.parametrize('storage', STORAGES)
rosbag2_storages = pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])


def write(storage: str, path: Path) -> Path:
    return (writer := BagBuilder(storage)).write(path, images(writer))


def stamps(path: Path) -> list[int]:
    return [frame.stamp_ns for frame in open_sequence(str(path), camera=PINHOLE)]


@rosbag2_storages
@pytest.mark.parametrize('name', ['drive.bag', 'drive.mcap', 'drive.db3'])
def test_a_folder_with_the_name_of_a_file(name, storage, tmp_path):
    write(storage, tmp_path / 'walk').rename(tmp_path / name)
    assert stamps(tmp_path / name) == STAMPS_NS


@every_storage
@pytest.mark.parametrize('suffix', ['.bag', '.mcap', '.db3', '.active', ''])
def test_the_content_of_a_file_decides(suffix, storage, tmp_path):
    path = write(storage, tmp_path / 'walk')
    file = path if path.is_file() else next(path.glob('walk.*'))
    renamed = tmp_path / f'other{suffix}'
    shutil.move(file, renamed)
    assert stamps(renamed) == STAMPS_NS


@rosbag2_storages
def test_a_folder_without_metadata(storage, tmp_path, caplog):
    path = write(storage, tmp_path / 'walk')
    (path / 'metadata.yaml').unlink()
    assert stamps(path) == STAMPS_NS
    warning, = caplog.records
    assert 'there is no metadata.yaml' in warning.message and 'reading walk.' in warning.message


@rosbag2_storages
@pytest.mark.parametrize('damage', [
    lambda text: text.replace('storage_identifier', 'x'), lambda text: 'title: [holiday',
    lambda text: '[1]', lambda text: text.replace('walk.', 'renamed.'), lambda text: '',
    lambda text: text.replace('version: 9', 'version: 99'),
    lambda text: text.replace('relative_file_paths', 'paths'),
    lambda text: text.replace('message_count: 5', 'message_count: many')])
def test_metadata_that_does_not_fit(damage, storage, tmp_path):
    path = write(storage, tmp_path / 'walk')
    metadata = path / 'metadata.yaml'
    metadata.write_text(damage(metadata.read_text()))
    assert stamps(path) == STAMPS_NS


def test_fewer_messages_than_the_metadata_states(tmp_path, caplog):
    path = write('mcap', tmp_path / 'walk')
    metadata = path / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('message_count: 5', 'message_count: 9'))
    sequence = open_sequence(str(path), camera=PINHOLE)
    assert len(list(sequence)) == COUNT
    assert sequence.left_out == {'missing': 4}
    assert 'found 5 of the 9 messages on /cam0/image_raw' in caplog.text


def split(storage: str, path: Path, parts: int = 3) -> Path:
    """Write a recording in files of which each has its own images."""
    writer = BagBuilder(storage)
    path.mkdir()
    names = []
    for part in range(parts):
        chosen = images(writer)[part * COUNT // parts:(part + 1) * COUNT // parts]
        folder = writer.write(path / f'part{part}', chosen)
        file = next(folder.glob('part*.*'))
        names.append(f'walk_{part + 9}{file.suffix}')
        shutil.move(file, path / names[-1])
        metadata = yaml.safe_load((folder / 'metadata.yaml').read_text())
        shutil.rmtree(folder)
    information = metadata['rosbag2_bagfile_information']
    information['relative_file_paths'] = names
    information['topics_with_message_count'][0]['message_count'] = COUNT
    (path / 'metadata.yaml').write_text(yaml.safe_dump(metadata))
    return path


@rosbag2_storages
def test_split_recordings(storage, tmp_path, caplog):
    path = split(storage, tmp_path / 'walk')
    assert stamps(path) == STAMPS_NS and not caplog.records
    (path / 'metadata.yaml').unlink()
    assert stamps(path) == STAMPS_NS
    with Bag(path) as bag:
        assert bag.count('/cam0/image_raw') == COUNT
        assert (bag.start_ns, bag.end_ns) == (STAMPS_NS[0] + LATER_NS,
                                              STAMPS_NS[-1] + LATER_NS + 1)


@rosbag2_storages
@pytest.mark.parametrize('damage', ['missing', 'empty', 'junk'])
def test_one_of_several_files_is_damaged(damage, storage, tmp_path, caplog):
    path = split(storage, tmp_path / 'walk')
    file = sorted(path.glob('walk_*'), key=lambda file: len(file.name))[1]
    if damage == 'missing':
        file.unlink()
    else:
        file.write_bytes(b'' if damage == 'empty' else b'junk' * 100)
    kept = stamps(path)
    assert 3 <= len(kept) < COUNT and set(kept) < set(STAMPS_NS)
    assert f'found {len(kept)} of the {COUNT} messages' in caplog.text


@rosbag2_storages
@pytest.mark.parametrize('mode', ['FILE', 'MESSAGE'])
@pytest.mark.parametrize('has_metadata', [True, False])
def test_compression_of_files_and_of_messages(has_metadata, mode, storage, tmp_path):
    writer = BagBuilder(storage)
    recorder = rosbag2.Writer(tmp_path / 'walk', version=9,
                              storage_plugin=rosbag2.StoragePlugin[storage.upper()])
    recorder.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    with recorder:
        kind = 'sensor_msgs/msg/Image'
        connection = recorder.add_connection('/image', kind, typestore=writer.store)
        for _, bag_time_ns, message in images(writer):
            recorder.write(connection, bag_time_ns, writer.store.serialize_cdr(message, kind))
    if not has_metadata:
        (tmp_path / 'walk' / 'metadata.yaml').unlink()
    assert stamps(tmp_path / 'walk') == STAMPS_NS


def test_a_message_that_unpacks_to_a_gigabyte_is_left_out(tmp_path, caplog):
    writer = BagBuilder('sqlite3')
    path = writer.write(tmp_path / 'walk', images(writer))
    with sqlite3.connect(path / 'walk.db3') as database:
        database.execute('UPDATE messages SET data = ? WHERE id = 2',
                         (zstandard.compress(bytes(1 << 28) + bytes(9)),))
    database.close()
    assert stamps(path) == [STAMPS_NS[index] for index in (0, 2, 3, 4)]
    assert 'cannot be decoded' in caplog.text


def test_a_folder_of_images_stays_one_beside_a_recording(tmp_path):
    write_image(tmp_path / '0.png', make_image(0))
    (tmp_path / 'x.mcap').touch()
    assert len(list(open_sequence(str(tmp_path), camera=PINHOLE))) == 1


@pytest.mark.parametrize(('make', 'message'), [
    (lambda path: path.touch(), 'x.mcap: the file is empty'),
    (lambda path: path.write_bytes(b'junk' * 9), 'cannot read the bag'),
    (lambda path: os.mkfifo(path), 'neither file nor folder'),
    (lambda path: path.mkdir(), 'no metadata.yaml'),
    (lambda path: None, 'x.mcap does not exist')])
def test_what_is_no_bag(make, message, tmp_path):
    make(tmp_path / 'x.mcap')
    with pytest.raises(KfvoError, match=message):
        open_sequence(str(tmp_path / 'x.mcap'), kind='bag')
