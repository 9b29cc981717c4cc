# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ranges of rendered sequences, and lists of names and numbers."""

from __future__ import annotations

import pytest

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence
from kfvo_ros.utils.commands import MAX_SEEDS, expand_ranges, parse_names, parse_numbers


def test_a_range_is_every_seed_in_it():
    texts = expand_ranges(['synthetic:8-10:fast', 'a/path-3-4', 'synthetic:7', 'synthetic:2-2'])
    assert texts == ('synthetic:8:fast', 'synthetic:9:fast', 'synthetic:10:fast', 'a/path-3-4',
                     'synthetic:7', 'synthetic:2')
    assert open_sequence(texts[0]).name == 'synthetic:8:fast'


@pytest.mark.parametrize('text', ['synthetic:4-3', f'synthetic:0-{MAX_SEEDS}'])
def test_empty_and_endless_ranges_are_refused(text):
    with pytest.raises(KfvoError, match=f'expected synthetic:A-B.*{text}'):
        expand_ranges([text])


def test_lists_of_names_and_numbers():
    assert parse_names('b,a,b', 'letters', ('a', 'b', 'c')) == ('b', 'a')
    assert parse_numbers('2,1,2', 'seeds') == (2, 1)
    with pytest.raises(KfvoError, match="letters: expected names out of a, b, came 'd'"):
        parse_names('a,d', 'letters', ('a', 'b'))
    for text in ('', '1,', '1.5', '-1', '²', '0'):
        with pytest.raises(KfvoError, match='workers: expected whole numbers from 1'):
            parse_numbers(text, 'workers', 1)
