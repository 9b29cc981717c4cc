# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of tensors in which damage is found: safetensors with a digest, checked ZIP files.

A flipped bit in a tensor is a number like any other. Files written here hold their SHA-256; in
files of other programs, and of older versions, the CRC-32 of PyTorch's ZIP format is checked.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save

from kfvo_ros.utils.files import atomic_write, open_file

MAX_BYTES = 2 ** 32
"""Largest file that is read."""
MAX_NUMBER = 1e12
"""Larger numbers come from damage: a flip of an exponent's highest bits gives 1e18 and more."""
ZIP_COMMENT = b'sha256:'
METADATA = b'{"__metadata__":{'
"""Begin of the JSON header of safetensors, after the 8 bytes of its size."""
ENTRY, ENTRY_SIZE = b'"sha256":"', 80
"""First entry of the metadata; the header's size stays a multiple of 8."""


class DamagedFileError(ValueError):
    """The content of a file is not what was written."""

    def __init__(self, checksum: str) -> None:
        super().__init__(f'it is damaged, its {checksum} is not the stored one: copy it again')


def write_tensors(path: Path, key: str, metadata: dict[str, Any],
                  tensors: Mapping[str, np.ndarray]) -> None:
    """Write a safetensors file with `metadata` as JSON under `key`, atomically.

    Raises OSError, SafetensorError.
    """
    content = save({name: np.ascontiguousarray(each) for name, each in tensors.items()},
                   {key: json.dumps(metadata)})
    with atomic_write(path) as draft:
        draft.write_bytes(sign_safetensors(content))


def read_tensors(path: Path, key: str) -> tuple[Any, dict[str, np.ndarray]]:
    """Return metadata and tensors of a file of `write_tensors`, which may lack the digest.

    Raises DamagedFileError where the digest differs; OSError, SafetensorError, ValueError,
    TypeError or RecursionError for another file.
    """
    with open_file(path, MAX_BYTES) as stored:
        _check_safetensors(stored.read())
    with safe_open(path, 'np') as file:
        text = (file.metadata() or {}).get(key)
        if text is None:
            raise ValueError(f'other tensors came, without {key}')
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    return json.loads(text), tensors


def sign_safetensors(content: bytes) -> bytes:
    """Return a safetensors file that has metadata with its SHA-256 as their first entry.

    safetensors itself writes several entries in random order.
    """
    digest = hashlib.sha256(content).hexdigest().encode()
    entry = (ENTRY + digest + b'",').ljust(ENTRY_SIZE)
    header_size, start = int.from_bytes(content[:8], 'little'), 8 + len(METADATA)
    return ((header_size + ENTRY_SIZE).to_bytes(8, 'little') + content[8:start] + entry
            + content[start:])


def _check_safetensors(content: bytes) -> None:
    """Raise DamagedFileError where the digest of a file of `sign_safetensors` differs."""
    header_size, start = int.from_bytes(content[:8], 'little'), 8 + len(METADATA)
    if content[start:].startswith(ENTRY):
        unsigned = (max(header_size - ENTRY_SIZE, 0).to_bytes(8, 'little') + content[8:start]
                    + content[start + ENTRY_SIZE:])
        if sign_safetensors(unsigned) != content:
            raise DamagedFileError('SHA-256')


def is_sane(array: np.ndarray) -> bool:
    """Whether all numbers are finite and at most MAX_NUMBER in size."""
    return array.size == 0 or bool(np.abs(array).max() <= MAX_NUMBER)  # NaN is not


def sign_zip(content: bytes) -> bytes:
    """Return a ZIP file without a comment with one that holds its SHA-256."""
    comment = ZIP_COMMENT + hashlib.sha256(content).hexdigest().encode()
    return content[:-2] + struct.pack('<H', len(comment)) + comment


def check_signed_zip(content: bytes) -> None:
    """Check the digest of a file of `sign_zip`, and the CRC-32 of one without a comment.

    Raises DamagedFileError where it differs; any Exception for another file.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        size = len(archive.comment)
    if size == 0 and content.endswith(bytes(2)):  # which are the size of the comment
        check_zip(io.BytesIO(content))
    elif sign_zip(content[:-size - 2] + bytes(2)) != content:
        raise DamagedFileError('SHA-256')


def check_zip(file: Path | IO[bytes]) -> None:
    """Check the CRC-32 of all members of a ZIP file; a gigabyte takes a fraction of a second.

    Raises DamagedFileError where one differs; any Exception for another file. PyTorch can write
    files without, in which none matches.
    """
    with zipfile.ZipFile(file) as archive:
        intact = [_is_intact(archive, member) for member in archive.infolist()]
    if any(intact) and not all(intact):
        raise DamagedFileError('CRC-32')


def _is_intact(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bool:
    try:
        with archive.open(member) as file:
            while file.read(2 ** 20):
                pass
    except zipfile.BadZipFile:
        return False
    return True
