# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damage to files: flipped bits, a lost sector, and cuts; the same for the same generator."""

from __future__ import annotations

from pathlib import Path

import numpy as np

EDGE, SECTOR = 512, 512
"""Bytes at both ends of a file, where headers and indices are, and bytes of a lost sector."""
BITS = 8
"""Bits flipped where several are."""
SMALL_SHARE = 0.15
"""Share of tries that damage one of the smaller files of an input."""


def choose_file(files: list[Path], rng: np.random.Generator) -> Path:
    """Return one of the files, mostly the largest."""
    ordered = sorted(files, key=lambda path: (-path.stat().st_size, path))
    if len(ordered) > 1 and rng.random() < SMALL_SHARE:
        return ordered[1 + int(rng.integers(len(ordered) - 1))]
    return ordered[0]


def damage(path: Path, rng: np.random.Generator) -> tuple[bool, str]:
    """Damage a file in place; return whether it was cut, and a description."""
    content = bytearray(path.read_bytes())
    size = len(content)
    way = rng.random()
    if way < 0.3:
        length = _position(size, rng)
        path.write_bytes(content[:length])
        return True, f'{path.name} cut to {length} of {size} bytes'
    if way < 0.4:
        begin = _position(size, rng) // SECTOR * SECTOR
        content[begin:begin + SECTOR] = bytes(len(content[begin:begin + SECTOR]))
        path.write_bytes(content)
        return False, f'{path.name} with zeros from byte {begin} to {begin + SECTOR}'
    flips = [(_position(size, rng), int(rng.integers(8)))
             for _ in range(BITS if way < 0.55 else 1)]
    for position, bit in flips:
        content[position] ^= 1 << bit
    path.write_bytes(content)
    where = ', '.join(f'bit {bit} of byte {position}' for position, bit in flips)
    return False, f'{path.name} with {where} flipped'


def _position(size: int, rng: np.random.Generator) -> int:
    """Return a position: half of them anywhere, a quarter near each end."""
    way, edge = rng.random(), min(EDGE, size)
    if way < 0.5:
        return int(rng.integers(size))
    near = int(rng.integers(edge))
    return near if way < 0.75 else size - 1 - near
