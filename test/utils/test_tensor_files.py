# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Digests of safetensors and ZIP files: every flip is found, older files are still read."""

from __future__ import annotations

import io
import json
import os
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from kfvo_ros.utils.tensor_files import (
    ENTRY,
    MAX_NUMBER,
    DamagedFileError,
    check_signed_zip,
    check_zip,
    is_sane,
    read_tensors,
    sign_zip,
    write_tensors,
)

KEY = 'kfvo_test'
METADATA = {'name': 'räum "1"', 'sizes': [3, 2.5, None]}
TENSORS = {'a': np.arange(6, dtype=np.float32).reshape(2, 3), 'ids': np.arange(3),
           'turned': np.eye(3)[:, ::-1]}


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / 'file.safetensors'
    write_tensors(path, KEY, METADATA, TENSORS)
    return path


def flipped(content: bytes, bit: int) -> bytes:
    """Return the content with one bit flipped."""
    changed = bytearray(content)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def make_zip() -> bytes:
    """Return a ZIP file of stored members, as torch.save writes them."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w') as archive:
        for name in ('data.pkl', 'data/0', 'data/1'):
            archive.writestr(f'archive/{name}', random.Random(name).randbytes(300))
    return file.getvalue()


def test_a_file_is_read_as_written_and_is_plain_safetensors(path):
    metadata, tensors = read_tensors(path, KEY)
    assert metadata == METADATA
    assert {name: (each.dtype, each.tolist()) for name, each in tensors.items()} == {
        name: (each.dtype, each.tolist()) for name, each in TENSORS.items()}
    assert set(load_file(path)) == set(TENSORS)
    header_size = int.from_bytes(path.read_bytes()[:8], 'little')
    assert header_size % 8 == 0  # which aligns the tensors


def test_the_same_content_is_the_same_bytes(path):
    before = path.read_bytes()
    write_tensors(path, KEY, METADATA, TENSORS)
    assert path.read_bytes() == before and before.count(ENTRY) == 1


def test_flips_outside_of_the_key_of_the_digest_are_found(path):
    content = path.read_bytes()
    key = range(8 * content.index(ENTRY), 8 * (content.index(ENTRY) + len(ENTRY)))
    silent = []
    for bit in range(0, 8 * len(content), 7):
        path.write_bytes(flipped(content, bit))
        try:
            read_tensors(path, KEY)
        except Exception:  # which its readers turn into one line
            continue
        silent.append(bit)
    assert set(silent) <= set(key)  # nothing but the name of the digest has changed then


def test_a_flip_in_a_tensor_names_the_digest(path):
    path.write_bytes(flipped(path.read_bytes(), -1 % (8 * path.stat().st_size)))
    with pytest.raises(DamagedFileError, match='its SHA-256 is not the stored one: copy it again'):
        read_tensors(path, KEY)


def test_a_file_of_an_older_version_has_no_digest(path):
    save_file(TENSORS, path, {KEY: json.dumps(METADATA)})
    assert read_tensors(path, KEY)[0] == METADATA


def test_a_fifo_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / 'fifo.safetensors')
    with pytest.raises(OSError, match='a FIFO'):
        read_tensors(tmp_path / 'fifo.safetensors', KEY)


@pytest.mark.parametrize(('value', 'sane'), [
    (0.0, True), (-MAX_NUMBER, True), (1.1 * MAX_NUMBER, False), (np.inf, False), (np.nan, False)])
def test_sane_numbers(value, sane):
    assert is_sane(np.array([1.0, value])) is sane
    assert is_sane(np.zeros(0))


def test_every_flip_in_a_signed_zip_file_is_found():
    content = sign_zip(make_zip())
    check_signed_zip(content)
    assert zipfile.ZipFile(io.BytesIO(content)).testzip() is None
    for bit in range(0, 8 * len(content), 3):
        with pytest.raises((DamagedFileError, zipfile.BadZipFile, ValueError, OSError,
                            NotImplementedError, UnicodeError)):
            check_signed_zip(flipped(content, bit))


def test_members_of_an_unsigned_zip_file_are_checked():
    content = make_zip()
    check_signed_zip(content)
    for name in ('data.pkl', 'data/0', 'data/1'):
        place = content.index(random.Random(name).randbytes(300))
        for offset in (0, 299):
            with pytest.raises(DamagedFileError, match='CRC-32'):
                check_signed_zip(flipped(content, 8 * (place + offset)))


def test_a_zip_file_without_checksums_is_not_refused():
    """PyTorch writes one where set_crc32_options is False."""
    content = make_zip()
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        sums = [member.CRC.to_bytes(4, 'little') for member in archive.infolist()]
    for each in sums:
        content = content.replace(each, b'none')
    check_zip(io.BytesIO(content))
