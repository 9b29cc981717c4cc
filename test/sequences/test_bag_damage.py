# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Truncated and overwritten bags: nothing is lost in silence."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from bag_writers import COUNT, PINHOLE, STORAGES, BagBuilder, images, truth_records

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence

every_storage = pytest.mark.parametrize('storage', STORAGES)


def bag_file(path: Path) -> Path:
    return path if path.is_file() else next(path.glob('walk.*'))


@pytest.mark.parametrize('kept', [0.0, 0.05, 0.5, 0.95])
@every_storage
def test_truncated_bags(storage, kept, tmp_path, caplog):
    writer = BagBuilder(storage)
    path = writer.write(tmp_path / 'walk', images(writer))
    data = bag_file(path).read_bytes()
    bag_file(path).write_bytes(data[:int(kept * len(data))])
    if (storage, kept) == ('mcap', 0.95):  # its one chunk is whole
        assert len(list(open_sequence(str(path), camera=PINHOLE))) == COUNT
        assert 'it has no end' in caplog.text
        return
    with pytest.raises(KfvoError, match='walk') as caught:
        list(open_sequence(str(path), camera=PINHOLE))
    assert '\n' not in str(caught.value)


@every_storage
def test_overwritten_bags_give_frames_or_say_why_not(storage, tmp_path, caplog):
    """Nothing is lost in silence: an error, a warning, or all frames and poses."""
    writer = BagBuilder(storage)
    path = writer.write(tmp_path / 'walk', images(writer) + truth_records(
        writer, '/truth', writer.odometry))
    data = bag_file(path).read_bytes()
    rng = np.random.default_rng(0)
    outcomes = Counter()
    for _ in range(40):
        caplog.clear()
        damaged = bytearray(data)
        start = int(rng.integers(len(data) - 40))
        damaged[start:start + 40] = rng.bytes(40)
        bag_file(path).write_bytes(damaged)
        try:
            sequence = open_sequence(str(path), camera=PINHOLE)
            frame_count = len(list(sequence))
            truth = sequence.ground_truth()
        except KfvoError as error:
            assert str(path) in str(error) or 'walk' in str(error)
            outcomes['error'] += 1
            continue
        is_whole = frame_count == COUNT and truth is not None and len(truth.trajectory) == COUNT
        assert is_whole or caplog.records, start
        outcomes['told' if caplog.records else 'whole'] += 1
    assert outcomes['error'] > 0 and outcomes['whole'] > 0


def test_metadata_of_something_else(tmp_path):
    (tmp_path / 'metadata.yaml').write_text('title: [holiday')
    with pytest.raises(KfvoError, match='cannot read the bag'):
        open_sequence(str(tmp_path))
