# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many sequences in few words: ``synthetic:A-B[:STYLE]``."""

from __future__ import annotations

import re
from collections.abc import Iterable

from kfvo_ros.errors import KfvoError

MAX_SEEDS = 10_000
RANGE = re.compile(r'(synthetic):([0-9]{1,10})-([0-9]{1,10})((?::[a-z]+)?)')


def spelled_out(texts: Iterable[str]) -> tuple[str, ...]:
    """Return the sequences one by one: ``synthetic:A-B`` are the seeds from A to B.

    Raises KfvoError for a range that is empty or too long.
    """
    return tuple(text for each in texts for text in _spell_out(each))


def _spell_out(text: str) -> list[str]:
    match = RANGE.fullmatch(text)
    if match is None:
        return [text]
    first, last = int(match[2]), int(match[3])
    if not 0 <= last - first < MAX_SEEDS:
        raise KfvoError(f'expected synthetic:A-B[:STYLE] with up to {MAX_SEEDS} seeds from A to '
                        f'B, came {text!r}')
    return [f'{match[1]}:{seed}{match[4]}' for seed in range(first, last + 1)]
