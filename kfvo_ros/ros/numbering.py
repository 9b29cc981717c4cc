# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What was lost before a subscription's callback, from the numbers its messages carry.

The message-lost event of ROS 2 knows of what the transport lost, not of what newer messages
pushed out of a full queue. The numbers that publishers give their messages show both.
"""

from __future__ import annotations


class Numbering:
    """Finds gaps in the numbers of one subscription's messages.

    rclpy does not tell which of several publishers sent a message, nor need it: whichever of
    them a number is taken to continue, the gaps have the same sum.
    """

    def __init__(self) -> None:
        self._publishers = 0
        self._last: list[int] = []

    def begin(self, publishers: int) -> None:
        """Count from anew: one of so many publishers is new, and its numbers begin anywhere."""
        self._publishers = publishers
        self._last.clear()

    def missing(self, number: int | None) -> int:
        """Return how many messages before `number` never came; None, of some DDS, tells nothing.

        What was published before a publisher's first message that came does not count.
        """
        if number is None:
            return 0
        last = max((each for each in self._last if each < number), default=None)
        if last is None or (number - last > 1 and len(self._last) < self._publishers):
            self._last.append(number)
            return 0
        self._last[self._last.index(last)] = number
        return number - last - 1
