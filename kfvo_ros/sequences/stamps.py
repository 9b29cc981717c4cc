# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which images of a camera have credible stamps: one rule for live cameras and for files.

A late image is left out. A lone stamp far from the others is left out. A jump of the clock counts
only when it persists: three images in a row on the new clock. Stamps that are all zero are
replaced by the times of arrival.
"""

from __future__ import annotations

import statistics
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

from kfvo_ros.trajectory import NANOSECONDS, format_stamp

PERSISTENCE = 3
"""Images in a row on a new clock that make it the clock."""
JUMP_NS = NANOSECONDS
"""Gap up to here is never a jump."""
JUMP_PERIODS = 10
"""Gap up to this number of image periods is never a jump."""
LATE_PERIODS = 3
"""An image up to this number of periods behind is late, further behind maybe on a new clock."""
REMEMBERED_GAPS = 9
Item = TypeVar('Item')


class Accepted(NamedTuple, Generic[Item]):
    """An image to process: its stamp, the caller's item, and whether the clock went back."""

    stamp_ns: int
    item: Item
    restart: bool = False


@dataclass(frozen=True)
class _Image(Generic[Item]):
    """An image with the stamp to use; `by_arrival` where that is the time of arrival."""

    stamp_ns: int
    arrival_ns: int | None
    by_arrival: bool
    item: Item


@dataclass
class _Clock:
    """The latest image of one clock, and the typical gap between its images."""

    last: _Image
    count: int = 1
    gaps: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED_GAPS))

    def add(self, image: _Image) -> None:
        self.gaps.append(image.stamp_ns - self.last.stamp_ns)
        self.last = image
        self.count += 1

    @property
    def limit_ns(self) -> int | None:
        """Longest gap that is no jump, None where one image alone does not show it."""
        return max(JUMP_NS, JUMP_PERIODS * self._period_ns) if self.gaps else None

    def precedes(self, image: _Image) -> bool:
        """Return whether the image is later by stamps of the same kind."""
        return image.stamp_ns > self.last.stamp_ns and image.by_arrival == self.last.by_arrival

    def continues(self, image: _Image) -> bool:
        """Return whether the image is the next one of this clock, without a jump."""
        if not self.precedes(image):
            return False
        gap_ns = image.stamp_ns - self.last.stamp_ns
        if image.arrival_ns is not None and self.last.arrival_ns is not None:
            # A pause of the camera shows in the times of arrival too.
            elapsed_ns = max(image.arrival_ns - self.last.arrival_ns, 0)
            return gap_ns - elapsed_ns <= (self.limit_ns or JUMP_NS)
        return self.limit_ns is None or gap_ns <= self.limit_ns

    def is_late(self, image: _Image) -> bool:
        """Return whether the image is an earlier one of this clock."""
        behind_ns = self.last.stamp_ns - image.stamp_ns
        tolerance_ns = LATE_PERIODS * self._period_ns if self.count >= PERSISTENCE else 0
        return image.by_arrival == self.last.by_arrival and 0 <= behind_ns <= tolerance_ns

    @property
    def _period_ns(self) -> int:
        return statistics.median_low(self.gaps)


class StampFilter(Generic[Item]):
    """Passes images on in the order of their stamps.

    An image that is not credible yet is held, at most two of them, until the next images show
    whether the clock jumped; then none of a jump that persists is lost. ``left_out`` counts the
    images left out as ``late`` or with an ``odd_stamp``, and ``reason`` describes the latest;
    ``jumps`` counts the jumps that persisted. ``by_arrival`` is True while zero stamps are
    replaced by times of arrival.
    """

    def __init__(self) -> None:
        self.left_out: Counter[str] = Counter()
        self.reason = ''
        self.jumps = 0
        self.reset()

    def reset(self) -> None:
        """Forget the clock, as when the user resets or /clock itself jumped."""
        self._clock: _Clock | None = None
        self._held: list[_Image[Item]] = []
        self._held_clock: _Clock | None = None
        self._first_zero: _Image[Item] | None = None

    @property
    def by_arrival(self) -> bool:
        """Whether the stamps in use are times of arrival."""
        return self._clock is not None and self._clock.last.by_arrival

    def push(self, stamp_ns: int, item: Item, arrival_ns: int | None = None
             ) -> list[Accepted[Item]]:
        """Take the next image; return those to process now, mostly this one.

        `arrival_ns` is the time of arrival (the bag time in files), None where there is none;
        it replaces a stamp of zero, and distinguishes a pause from a jump.
        """
        image = _Image(stamp_ns, arrival_ns, False, item)
        if stamp_ns == 0 and arrival_ns:
            image = _Image(arrival_ns, arrival_ns, True, item)
        if self._clock is not None:
            return self._follow(self._clock, image)
        if self._first_zero is not None:
            return self._start_after_zero(self._first_zero, image)
        if image.by_arrival:  # zero may be the start of a clock: the next image shows it
            self._first_zero = image
            return []
        return self._start(image)

    def finish(self) -> list[Accepted[Item]]:
        """Return what is credible of the images held when no more come; leave out the others."""
        self._drop_held()
        return [] if self._first_zero is None else self._start(self._first_zero)

    def _start(self, image: _Image[Item]) -> list[Accepted[Item]]:
        self._clock, self._first_zero = _Clock(image), None
        return [Accepted(image.stamp_ns, image.item)]

    def _start_after_zero(self, zero: _Image[Item], image: _Image[Item]
                          ) -> list[Accepted[Item]]:
        """Start with a stamp of zero and the image after it."""
        if not image.by_arrival:
            elapsed_ns = max((image.arrival_ns or 0) - (zero.arrival_ns or 0), 0)
            if image.stamp_ns > JUMP_NS + JUMP_PERIODS * elapsed_ns:
                self._leave_out('odd_stamp', zero)
                return self._start(image)
            zero = _Image(0, zero.arrival_ns, False, zero.item)
        started = self._start(zero)
        return started if self._clock is None else started + self._follow(self._clock, image)

    def _follow(self, clock: _Clock, image: _Image[Item]) -> list[Accepted[Item]]:
        """Take an image after others."""
        if clock.continues(image):
            self._drop_held()
            clock.add(image)
            return [Accepted(image.stamp_ns, image.item)]
        if clock.is_late(image):
            self._drop_held()
            self._leave_out('late', image)
            return []
        if self._held_clock is not None and self._held_clock.is_late(image):
            self._leave_out('late', image)
            return []
        if self._held_clock is not None and self._held_clock.precedes(image):
            self._held_clock.add(image)
        else:
            self._drop_held()
            self._held_clock = _Clock(image)
        self._held.append(image)
        return self._switch(clock, self._held_clock) if len(self._held) == PERSISTENCE else []

    def _switch(self, old: _Clock, new: _Clock) -> list[Accepted[Item]]:
        """Go over to the clock of the held images, and return these."""
        held, self._held = self._held, []
        self._clock, self._held_clock = new, None
        self.jumps += 1
        goes_back = held[0].stamp_ns <= old.last.stamp_ns
        return [Accepted(image.stamp_ns, image.item, goes_back and image is held[0])
                for image in held]

    def _drop_held(self) -> None:
        for image in self._held:
            self._leave_out('odd_stamp', image)
        self._held, self._held_clock = [], None

    def _leave_out(self, kind: str, image: _Image[Item]) -> None:
        self.left_out[kind] += 1
        self.reason = f'left out the image of stamp {format_stamp(image.stamp_ns)} s'
        if self._clock is not None:
            after_s = (image.stamp_ns - self._clock.last.stamp_ns) / NANOSECONDS
            self.reason += (f', {abs(after_s):.3f} s {"after" if after_s > 0 else "before"} that '
                            'of the image before it')


class OrderedImages(Generic[Item]):
    """The images of a file with credible, strictly increasing stamps.

    ``left_out`` counts what was left out so far, as `StampFilter` does. Where the clock goes
    back for good, images are late until their stamps pass those before; ``restarts`` counts it.
    ``by_arrival`` is True if zero stamps were replaced by times of arrival.
    """

    def __init__(self) -> None:
        self.left_out: Counter[str] = Counter()
        self.restarts = 0
        self.by_arrival = False

    def select(self, images: Iterable[tuple[int, int | None, Item]]
               ) -> Iterator[tuple[int, Item]]:
        """Yield (stamp_ns, item) of the (stamp_ns, arrival_ns or None, item) to process.

        The first images wait until a clock is established, because the very first stamp may be
        the odd one.
        """
        filtered: StampFilter[Item] = StampFilter()
        self.left_out = filtered.left_out
        first: list[Accepted[Item]] | None = []
        last_ns: int | None = None
        for accepted in self._filter(filtered, images):
            if first is not None:
                if filtered.jumps:  # before a clock was established
                    first = self._of_same_clock(first, accepted)
                first += accepted
                if len(first) < PERSISTENCE:
                    continue
                accepted, first = first, None
            elif any(image.restart for image in accepted):
                self.restarts += 1
            for image in accepted:
                if last_ns is not None and image.stamp_ns <= last_ns:
                    self.left_out['late'] += 1
                    continue
                last_ns = image.stamp_ns
                yield image.stamp_ns, image.item
        yield from ((image.stamp_ns, image.item) for image in first or ())

    def _filter(self, filtered: StampFilter[Item], images: Iterable[tuple[int, int | None, Item]]
                ) -> Iterator[list[Accepted[Item]]]:
        """Yield what the filter passes on, to the end."""
        for stamp_ns, arrival_ns, item in images:
            accepted = filtered.push(stamp_ns, item, arrival_ns)
            self.by_arrival |= filtered.by_arrival
            if accepted:
                yield accepted
        yield filtered.finish()
        self.by_arrival |= filtered.by_arrival

    def _of_same_clock(self, before: list[Accepted[Item]], after: list[Accepted[Item]]
                       ) -> list[Accepted[Item]]:
        """Return the images of `before` that fit the clock of those `after` them."""
        start_ns = after[0].stamp_ns
        limit_ns = max(JUMP_NS, JUMP_PERIODS * (after[1].stamp_ns - start_ns))
        kept = [image for image in before if 0 < start_ns - image.stamp_ns <= limit_ns]
        self.left_out['odd_stamp'] += len(before) - len(kept)
        return kept
