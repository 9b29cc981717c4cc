# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of encoded sequences."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.training.encoded_sequence import (
    FILE_KEY,
    EncodedSequence,
    encode_sequence,
    read_encoded_sequence,
    write_encoded_sequence,
)


@pytest.fixture(scope='module')
def sequence() -> EncodedSequence:
    return encode_sequence(SyntheticSequence(2, 'smooth', 8, 160, 120), GeometricBackbone())


def test_a_sequence_is_read_from_its_file_as_written(sequence, tmp_path):
    path = tmp_path / 'sequence.safetensors'
    write_encoded_sequence(path, sequence)
    read = read_encoded_sequence(path)
    assert read.name == sequence.name and len(read) == len(sequence) == 8
    np.testing.assert_array_equal(read.T_truth_camera, sequence.T_truth_camera)
    for ours, theirs in zip(read.encoded, sequence.encoded, strict=True):
        assert ours.stamp_ns == theirs.stamp_ns and ours.payload.index == theirs.payload.index
        np.testing.assert_array_equal(ours.descriptor, theirs.descriptor)
        for a, b in ((ours.tracks, theirs.tracks), (ours.payload.tracks, theirs.payload.tracks)):
            np.testing.assert_array_equal(a.ids, b.ids)
            np.testing.assert_array_equal(a.pixels, b.pixels)
            np.testing.assert_array_equal(a.uncertainty, b.uncertainty)
        np.testing.assert_array_equal(ours.payload.points, theirs.payload.points)
    assert read.frames[0].camera == sequence.frames[0].camera
    assert sequence.encoded[-1].tracks.uncertainty.any()


@pytest.mark.parametrize('damage', [b'', b'nonsense', b'\x00' * 100])
def test_a_damaged_file_is_read_as_none(tmp_path, damage):
    path = tmp_path / 'sequence.safetensors'
    path.write_bytes(damage)
    assert read_encoded_sequence(path) is None


def test_a_flipped_bit_is_read_as_none(sequence_file, tmp_path):
    path, content = tmp_path / 'sequence.safetensors', bytearray(sequence_file.read_bytes())
    for place in (len(content) // 2, -1):
        content[place] ^= 1
        path.write_bytes(content)
        assert read_encoded_sequence(path) is None
        content[place] ^= 1
    path.write_bytes(content)
    assert read_encoded_sequence(path) is not None


@pytest.fixture(scope='module')
def sequence_file(sequence, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp('sequence') / 'sequence.safetensors'
    write_encoded_sequence(path, sequence)
    return path


@pytest.mark.parametrize('camera', [{'distortion_model': 5}, {'fx': -1}, {'fx': 10 ** 400}])
def test_a_file_with_an_invalid_camera_is_read_as_none(sequence_file, tmp_path, camera):
    path = tmp_path / 'sequence.safetensors'
    with safe_open(sequence_file, 'np') as file:
        metadata = json.loads(file.metadata()[FILE_KEY])
    save_file(load_file(sequence_file), path, {FILE_KEY: json.dumps(metadata)})
    assert read_encoded_sequence(path) is not None
    metadata['camera'] |= camera
    save_file(load_file(sequence_file), path, {FILE_KEY: json.dumps(metadata)})
    assert read_encoded_sequence(path) is None


@pytest.mark.parametrize(('name', 'change'), [
    ('T_truth_camera', lambda array: array[:3]),
    ('T_truth_camera', lambda array: array[:, :3]),
    ('T_truth_camera', lambda array: array * np.nan),
    ('descriptors', lambda array: array[:, :-1]),
    ('descriptors', lambda array: array * np.inf),
    ('counts', lambda array: array + 1),
    ('ids', lambda array: array[1:]),
    ('pixels', lambda array: array * np.nan)])
def test_a_file_with_inconsistent_arrays_is_read_as_none(sequence_file, tmp_path, name, change):
    path = tmp_path / 'sequence.safetensors'
    arrays = load_file(sequence_file)
    with safe_open(sequence_file, 'np') as file:
        metadata = {FILE_KEY: file.metadata()[FILE_KEY]}
    changed = np.ascontiguousarray(change(arrays[name]))
    save_file(arrays | {name: changed}, path, metadata)
    assert read_encoded_sequence(path) is None
