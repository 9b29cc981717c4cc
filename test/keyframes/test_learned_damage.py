# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged policy files: flipped bits, cut files, numbers that no training gives, older files."""

from __future__ import annotations

import os
import random
from pathlib import Path

import numpy as np
import pytest
from policies import ALWAYS, write_policy
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from kfvo_ros import run
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.learned import (
    METADATA_KEY,
    PolicySignature,
    find_policy,
    read_policy,
)

SIGNATURE = PolicySignature('geometric', 'depth', 8, (('gap', 3),))
EXPECTED = 'expected a policy that kfvo_train wrote'


@pytest.fixture
def path(tmp_path) -> Path:
    return write_policy(tmp_path / 'policy.safetensors', SIGNATURE, ALWAYS)


def write_unsigned(path: Path, **changes: np.ndarray) -> None:
    """Write a policy as an older version did, with some tensors changed."""
    with safe_open(path, 'np') as file:
        metadata = {METADATA_KEY: file.metadata()[METADATA_KEY]}
    save_file(load_file(path) | changes, path, metadata)


def refusal_of(path: Path) -> str:
    """Return the one line with which a file is refused."""
    with pytest.raises(KfvoError) as refusal:
        read_policy(path)
    line = str(refusal.value)
    assert str(path) in line and EXPECTED in line and len(line.splitlines()) == 1
    return line


@pytest.mark.parametrize('bundled', [False, True])
def test_flipped_bits_are_refused(bundled, path, tmp_path):
    content = (find_policy(None, 'geometric') if bundled else path).read_bytes()
    damaged, rng, named = tmp_path / 'damaged.safetensors', random.Random(0), 0
    for _ in range(40):
        changed, bit = bytearray(content), rng.randrange(8 * len(content))
        changed[bit // 8] ^= 1 << bit % 8
        damaged.write_bytes(changed)
        named += 'it is damaged, its SHA-256 is not the stored one: copy it again' \
            in refusal_of(damaged)
    assert named >= 30  # others are no safetensors files any more
    damaged.write_bytes(content)
    read_policy(damaged)


def test_cut_files_are_refused(path, tmp_path):
    content, cut = path.read_bytes(), tmp_path / 'cut.safetensors'
    for size in (0, 7, 8, 50, 100, 300, len(content) // 2, len(content) - 1):
        cut.write_bytes(content[:size])
        refusal_of(cut)


def test_a_policy_of_an_older_version_has_no_digest(path):
    written = read_policy(path)
    write_unsigned(path)
    seen = np.ones((1, 3), np.float32)
    assert read_policy(path).signature == written.signature
    np.testing.assert_array_equal(read_policy(path).actor.logits(seen), written.actor.logits(seen))


@pytest.mark.parametrize('number', [np.nan, np.inf, 1e13, -3e38])
@pytest.mark.parametrize('name', ['mean', 'std', 'layers.1.weight', 'layers.2.bias'])
def test_numbers_that_no_training_gives_are_refused(name, number, path):
    changed = load_file(path)[name]
    changed.flat[0] = number
    write_unsigned(path, **{name: changed})
    assert 'numbers up to 1e+12 and a positive std are needed' in refusal_of(path)


def test_a_fifo_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / 'policy.safetensors')
    assert 'expected a file, found a FIFO' in refusal_of(tmp_path / 'policy.safetensors')


def test_a_damaged_policy_is_one_line_before_anything_is_written(path, tmp_path, capsys):
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    assert run.main(['synthetic:1:smooth', '--keyframes', 'learned', '--policy', str(path),
                     '--output', str(tmp_path / 'out')]) == 1
    line, = capsys.readouterr().err.splitlines()
    assert line.startswith('kfvo_run: error: ') and 'it is damaged' in line
    assert not (tmp_path / 'out').exists()
