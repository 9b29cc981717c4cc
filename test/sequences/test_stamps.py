# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which images have credible stamps: late ones, odd ones, jumps that persist, zeros."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros.sequences.stamps import OrderedImages, StampFilter
from kfvo_ros.trajectory import NANOSECONDS

COUNT = 24
PERIOD_NS = 50_000_000
START_NS = 1_700_000_000 * NANOSECONDS
STAMPS_NS = [START_NS + PERIOD_NS * index for index in range(COUNT)]
HOUR_NS = 3600 * NANOSECONDS


def select(stamps_ns: list[int], arrivals_ns: list[int] | None = None
           ) -> tuple[list[int], OrderedImages]:
    """Return the indices of the images that a file passes on, and the selection."""
    ordered: OrderedImages[int] = OrderedImages()
    arrivals = arrivals_ns or [None] * len(stamps_ns)
    passed = list(ordered.select(zip(stamps_ns, arrivals, range(len(stamps_ns)))))
    kept = [stamp_ns for stamp_ns, _ in passed]
    assert kept == sorted(set(kept))
    return [index for _, index in passed], ordered


def push_all(stamps_ns: list[int], arrivals_ns: list[int] | None = None
             ) -> tuple[list[int], list[int], StampFilter]:
    """Return the indices that a live camera passes on, those that restart, and the filter."""
    live: StampFilter[int] = StampFilter()
    arrivals = arrivals_ns or [None] * len(stamps_ns)
    passed = [each for index, (stamp_ns, arrival_ns) in enumerate(zip(stamps_ns, arrivals))
              for each in live.push(stamp_ns, index, arrival_ns)]
    return ([each.item for each in passed], [each.item for each in passed if each.restart], live)


@pytest.mark.parametrize('arrivals', [None, STAMPS_NS], ids=['stamps only', 'with arrivals'])
def test_good_stamps_pass_unchanged(arrivals):
    kept, ordered = select(STAMPS_NS, arrivals)
    assert kept == list(range(COUNT)) and not ordered.left_out and not ordered.restarts
    assert push_all(STAMPS_NS, arrivals)[:2] == (kept, [])


@pytest.mark.parametrize('offset_ns', [2 * NANOSECONDS, 60 * NANOSECONDS, HOUR_NS,
                                       -2 * NANOSECONDS, -HOUR_NS, -START_NS])
@pytest.mark.parametrize('odd', [1, 2, 3, 10, COUNT - 2, COUNT - 1])
@pytest.mark.parametrize('arrivals', [None, STAMPS_NS], ids=['stamps only', 'with arrivals'])
def test_one_odd_stamp_is_left_out(arrivals, odd, offset_ns):
    stamps_ns = list(STAMPS_NS)
    stamps_ns[odd] = max(stamps_ns[odd] + offset_ns, 0)
    kept, ordered = select(stamps_ns, arrivals)
    assert kept == [index for index in range(COUNT) if index != odd]
    assert ordered.left_out == {'odd_stamp': 1} and not ordered.restarts


@pytest.mark.parametrize('offset_ns', [60 * NANOSECONDS, HOUR_NS, -HOUR_NS, -START_NS])
def test_the_first_stamp_is_the_odd_one(offset_ns):
    stamps_ns = [max(STAMPS_NS[0] + offset_ns, 0), *STAMPS_NS[1:]]
    kept, ordered = select(stamps_ns, STAMPS_NS)
    assert kept == list(range(1, COUNT)) and ordered.left_out == {'odd_stamp': 1}


def test_late_images_are_left_out():
    stamps_ns = list(STAMPS_NS)
    for first in (10, 15):
        stamps_ns[first], stamps_ns[first + 1] = stamps_ns[first + 1], stamps_ns[first]
    kept, restarts, live = push_all(stamps_ns)
    assert kept == [index for index in range(COUNT) if index not in (11, 16)]
    assert not restarts and live.left_out == {'late': 2}
    assert '0.050 s before' in live.reason


def test_a_repeated_stamp_is_late():
    kept, ordered = select([stamp_ns for stamp_ns in STAMPS_NS for _ in range(2)])
    assert kept == list(range(0, 2 * COUNT, 2)) and ordered.left_out == {'late': COUNT}


@pytest.mark.parametrize('offset_ns', [HOUR_NS, -5 * NANOSECONDS, 5 * NANOSECONDS])
def test_a_second_publisher_resets_nothing(offset_ns):
    """40 images of two clocks in turn; one clock is taken, the other left out."""
    stamps_ns = [stamp_ns for first in STAMPS_NS[:20] for stamp_ns in (first, first + offset_ns)]
    arrivals_ns = [first for first in STAMPS_NS[:20] for _ in range(2)]
    kept, restarts, live = push_all(stamps_ns, arrivals_ns)
    assert kept == list(range(0, 40, 2)) and not restarts
    assert live.left_out['odd_stamp'] in (19, 20)


def test_a_clock_that_goes_back_restarts_once_and_loses_no_image():
    kept, restarts, live = push_all(STAMPS_NS + STAMPS_NS)
    assert kept == list(range(2 * COUNT)) and restarts == [COUNT]
    assert live.jumps == 1 and not live.left_out


def test_a_jump_ahead_that_persists_continues_without_a_restart():
    stamps_ns = STAMPS_NS[:10] + [stamp_ns + HOUR_NS for stamp_ns in STAMPS_NS[10:]]
    kept, restarts, live = push_all(stamps_ns, STAMPS_NS)
    assert kept == list(range(COUNT)) and not restarts and live.jumps == 1
    assert select(stamps_ns, STAMPS_NS)[0] == kept


def test_two_images_ahead_do_not_persist():
    stamps_ns = list(STAMPS_NS)
    stamps_ns[10] += HOUR_NS
    stamps_ns[11] += HOUR_NS
    kept, restarts, live = push_all(stamps_ns)
    assert kept == [index for index in range(COUNT) if index not in (10, 11)]
    assert not restarts and live.left_out == {'odd_stamp': 2}


def test_in_a_file_a_clock_that_goes_back_is_late_until_it_passes():
    """NTP sets the clock back by 0.5 s: ten images are late, the others stay."""
    stamps_ns = STAMPS_NS[:12] + [stamp_ns - 10 * PERIOD_NS for stamp_ns in STAMPS_NS[12:]]
    kept, ordered = select(stamps_ns, STAMPS_NS)
    assert kept == [*range(12), *range(22, COUNT)]
    assert ordered.left_out == {'late': 10} and ordered.restarts == 1


def test_a_pause_is_no_jump_where_the_arrivals_show_it():
    stamps_ns = STAMPS_NS[:-1] + [STAMPS_NS[-1] + HOUR_NS]
    assert len(select(stamps_ns, stamps_ns)[0]) == COUNT
    assert len(push_all(stamps_ns, stamps_ns)[0]) == COUNT
    assert len(select(stamps_ns, STAMPS_NS)[0]) == COUNT - 1


@pytest.mark.parametrize('period_s', [0.001, 0.1, 1.0, 30.0])
@pytest.mark.parametrize('start_s', [0, 1_700_000_000])
def test_any_constant_rate_is_good(start_s, period_s):
    stamps_ns = [start_s * NANOSECONDS + int(period_s * NANOSECONDS) * index
                 for index in range(6)]
    assert select(stamps_ns)[0] == list(range(6))
    assert select(stamps_ns, stamps_ns)[0] == list(range(6))
    assert push_all(stamps_ns, stamps_ns)[0] == list(range(6))


def test_irregular_rates_are_good():
    gaps_ns = np.random.default_rng(0).uniform(0.01, 0.9, 500) * NANOSECONDS
    stamps_ns = (START_NS + np.cumsum(gaps_ns.astype(np.int64))).tolist()
    assert select(stamps_ns)[0] == list(range(500))


def test_zero_stamps_are_replaced_by_arrivals():
    ordered: OrderedImages[int] = OrderedImages()
    passed = list(ordered.select((0, arrival_ns, 0) for arrival_ns in STAMPS_NS))
    assert [stamp_ns for stamp_ns, _ in passed] == STAMPS_NS and ordered.by_arrival
    kept, restarts, live = push_all([0] * COUNT, STAMPS_NS)
    assert kept == list(range(COUNT)) and not restarts and live.by_arrival


def test_zero_is_a_stamp_of_a_clock_that_begins_there():
    stamps_ns = [PERIOD_NS * index for index in range(6)]
    live: StampFilter[int] = StampFilter()
    passed = [each.stamp_ns for index, stamp_ns in enumerate(stamps_ns)
              for each in live.push(stamp_ns, index, STAMPS_NS[index])]
    assert passed == stamps_ns and not live.by_arrival


@pytest.mark.parametrize('count', [1, 2])
def test_short_sequences_are_kept(count):
    assert select(STAMPS_NS[:count])[0] == list(range(count))
    assert select([0] * count, STAMPS_NS[:count])[0] == list(range(count))
    assert select([])[0] == []


def test_reset_forgets_the_clock():
    live: StampFilter[int] = StampFilter()
    assert live.push(HOUR_NS, 0) and live.push(HOUR_NS + PERIOD_NS, 1)
    assert not live.push(5, 2)
    live.reset()
    accepted, = live.push(5, 3)
    assert (accepted.item, accepted.restart) == (3, False)
