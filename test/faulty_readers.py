# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Readers that take damage badly, for the test of the tool that finds them."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from benchmarks.faults.outcomes import Answer

CONTENT = bytes(range(256)) * 4


def write(folder: Path) -> Path:
    """Write the undamaged input."""
    path = folder / 'numbers.bin'
    path.write_bytes(CONTENT)
    return path


def _is_whole(path: Path) -> bool:
    return path.read_bytes() == CONTENT


WHOLE = Answer(units=10, digest='whole', words=('always said',))


def raises(path: Path) -> Answer:
    if not _is_whole(path):
        raise IndexError('no such row')
    return WHOLE


def exits(path: Path) -> Answer:
    if not _is_whole(path):
        raise SystemExit(1)
    return WHOLE


def crashes(path: Path) -> Answer:
    if not _is_whole(path):
        os.kill(os.getpid(), signal.SIGSEGV)
    return WHOLE


def runs_out_of_memory(path: Path) -> Answer:
    return WHOLE if _is_whole(path) else Answer(error='out of memory: 10 GiB')


def hangs(path: Path) -> Answer:
    while not _is_whole(path):
        time.sleep(1.0)
    return WHOLE


def loses(path: Path) -> Answer:
    return WHOLE if _is_whole(path) else Answer(9, 'part', WHOLE.words)


def changes(path: Path) -> Answer:
    return WHOLE if _is_whole(path) else Answer(10, 'other', WHOLE.words)


def explains_at_length(path: Path) -> Answer:
    return WHOLE if _is_whole(path) else Answer(error='cannot read numbers.bin\nbecause\nof this')


def mumbles(path: Path) -> Answer:
    return WHOLE if _is_whole(path) else Answer(error='wrong CRC')


def tells(path: Path) -> Answer:
    return WHOLE if _is_whole(path) else Answer(9, 'part', (*WHOLE.words, '9 of 10'))


def refuses(path: Path) -> Answer:
    return WHOLE if _is_whole(path) else Answer(error='numbers.bin: expected 1024 bytes')


def ignores(path: Path) -> Answer:
    return WHOLE
