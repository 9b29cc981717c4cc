# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Playback of a bag onto ROS topics, at a rate of wall time."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from itertools import count
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from kfvo_ros.errors import KfvoError
from kfvo_ros.ros.messages import find_message_class, wire_format
from kfvo_ros.ros.options import PlayOptions
from kfvo_ros.ros.worker import ReadAhead
from kfvo_ros.sequences.bag.reader import COMPRESSED_IMAGE, IMAGE, Bag
from kfvo_ros.trajectory import NANOSECONDS
from kfvo_ros.utils.progress import progress_bar
from kfvo_ros.utils.signals import raise_if_interrupted, sleep

READ_AHEAD_BYTES = 16 * 1024 * 1024
DISCOVERY_S = 3.5
"""Time for running subscribers to be discovered: Fast DDS announces every 3 s."""
SETTLING_S = 0.2
"""Time from a publisher's discovery of its subscribers to their discovery of it."""
REMINDER_S = 5.0
"""Period of the log line about missing subscribers."""
ACKNOWLEDGEMENT_S = 5.0
"""Time for subscribers to confirm the last messages: Fast DDS asks every 3 s."""
REPORT_S = 10.0
"""Time within which a running kfvo_node reports its state, which it does each second."""
DEPTH = 10
"""Queue depth of topics that are not latched, whatever was recorded: where a message was lost, a
deeper queue of Fast DDS delays all later ones by seconds to send it again."""
MAX_LATCHED_DEPTH = 100
LATENESS_LIMIT_NS = 50_000_000
"""Lateness up to here is not logged."""
LOOP_GAP_S = 0.1
"""Pause between loops, so that a bag of one message does not flood its topic."""
BAR = '{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s of the bag'
_log = logging.getLogger(__name__)


class _Report(NamedTuple):
    """What a kfvo_node reports: images received, for how many reports it is idle, and when."""

    received: str
    idle: int
    arrival_s: float


class PlaybackClock:
    """Bag time that passes at `rate` times wall time; a delay shifts nothing after it.

    During waits `tick` is called with the bag time [ns], `frequency` times per second.
    """

    def __init__(self, rate: float, tick: Callable[[int], None] | None = None,
                 frequency: float = 1.0) -> None:
        self._rate, self._tick = rate, tick
        self._period_ns = round(NANOSECONDS / frequency)
        self.start(0)

    def start(self, bag_time_ns: int) -> None:
        """Set the bag time to `bag_time_ns` now."""
        self._start_bag_ns = bag_time_ns
        self._start_ns = self._next_tick_ns = time.monotonic_ns()

    def wait_until(self, bag_time_ns: int) -> int:
        """Sleep until `bag_time_ns`; return the lateness [ns]."""
        due_ns = self._start_ns + round((bag_time_ns - self._start_bag_ns) / self._rate)
        while True:
            now_ns = time.monotonic_ns()
            wake_ns = due_ns
            if self._tick is not None:
                if now_ns >= self._next_tick_ns:
                    self._tick(self._start_bag_ns + round((now_ns - self._start_ns) * self._rate))
                    missed = (now_ns - self._next_tick_ns) // self._period_ns
                    self._next_tick_ns += (missed + 1) * self._period_ns
                wake_ns = min(due_ns, self._next_tick_ns)
            if now_ns >= due_ns:
                return now_ns - due_ns
            sleep(max(wake_ns - now_ns, 0) / NANOSECONDS)


def make_node() -> Node:
    """Return the node of a player; it serves no parameters."""
    return Node('kfvo_play', start_parameter_services=False)


class Player:
    """Publishes topics of an open bag at their recorded times; late messages are not skipped.

    ``published`` is the number of messages published, ``position_s`` the bag time of the last one
    [s after the start]. Raises KfvoError when no topic can be published or `options` select
    nothing.
    """

    def __init__(self, node: Node, bag: Bag, topics: Iterable[str], options: PlayOptions) -> None:
        self._bag, self._options = bag, options
        self._start_ns, self._stop_ns = _time_range(bag, options)
        self._publishers = _make_publishers(node, bag, topics, options.clock is not None)
        if options.clock is None:
            self._playback_clock = PlaybackClock(options.rate)
        else:
            self._clock_publisher = node.create_publisher(Clock, '/clock', 10)
            self._playback_clock = PlaybackClock(options.rate, self._publish_clock, options.clock)
        self._reports: dict[str, _Report] = {}
        if options.wait_for_processing:
            node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._max_lateness_ns = 0
        self.published, self.position_s = 0, 0.0

    def play(self) -> None:
        """Play the bag, endlessly with the option `loop`; raises KfvoError where it is damaged."""
        self._await_subscribers()
        name = self._bag.path.name
        try:
            with progress_bar((self._stop_ns - self._start_ns) / NANOSECONDS, 's', name,
                              bar_format=BAR) as bar:
                self._play_once(bar)
                for loop in count(2) if self._options.loop else ():
                    sleep(LOOP_GAP_S)
                    bar.reset()
                    bar.set_description(f'{name}, loop {loop}')
                    self._play_once(bar)
        finally:
            self._log_lateness()
        self._await_acknowledgements()
        if self._options.wait_for_processing:
            self._await_processing()

    def _play_once(self, bar: Any) -> None:
        """Publish all selected messages; raises KfvoError when there are none."""
        started = False
        messages = self._bag.raw_messages(self._publishers, self._start_ns, self._stop_ns)
        with ReadAhead(messages, lambda message: len(message[2]), READ_AHEAD_BYTES) as ahead:
            for topic, bag_time_ns, cdr in ahead:
                if not started:
                    self._playback_clock.start(self._start_ns)
                    started = True
                lateness_ns = self._playback_clock.wait_until(bag_time_ns)
                self._publishers[topic].publish(cdr)
                self._max_lateness_ns = max(self._max_lateness_ns, lateness_ns)
                self.published += 1
                self.position_s = (bag_time_ns - self._start_ns) / NANOSECONDS
                bar.update(self.position_s - bar.n)
        if not started:
            raise KfvoError(f'{self._bag.path} has no message on {", ".join(self._publishers)} '
                            'within what --start and --duration select')

    def _publish_clock(self, bag_time_ns: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(bag_time_ns, NANOSECONDS)
        self._clock_publisher.publish(message)

    def _await_subscribers(self) -> None:
        """Wait for the required number of subscribers, or briefly for those that run already."""
        wanted = self._options.wait_for_subscribers
        images = self._bag.topics_of_type(IMAGE, COMPRESSED_IMAGE)
        awaited = {topic: publisher for topic, publisher in self._publishers.items()
                   if topic in images} or self._publishers
        began = reminded = time.monotonic()
        while missing := [publisher.topic_name for publisher in awaited.values()
                          if publisher.get_subscription_count() < (wanted or 1)]:
            now = time.monotonic()
            if wanted is None and now - began > DISCOVERY_S:
                _log.info('playing without a subscriber on %s', ', '.join(missing))
                return
            if now - reminded > REMINDER_S:
                reminded = now
                _log.info('waiting for %s on %s', 'a subscriber' if wanted == 1 else
                          f'{wanted} subscribers', ', '.join(missing))
            sleep(0.02)
        sleep(SETTLING_S)

    def _await_acknowledgements(self) -> None:
        """Wait a limited time until reliable subscribers confirm the last messages."""
        end = time.monotonic() + ACKNOWLEDGEMENT_S
        for publisher in self._publishers.values():
            while not publisher.wait_for_all_acked(Duration(seconds=0.05)):
                raise_if_interrupted()
                if time.monotonic() > end:
                    _log.warning('a subscriber of %s did not confirm the last messages',
                                 publisher.topic_name)
                    return

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Count the reports of each kfvo_node in a row in which it has nothing to do."""
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            if 'images waiting' in values:
                received, last = values['images received'], self._reports.get(status.name)
                idle = values['images waiting'] == '0' and last and last.received == received
                self._reports[status.name] = _Report(
                    received, last.idle + 1 if idle and last else 0, time.monotonic())

    def _await_processing(self) -> None:
        """Wait until every node that reports has been idle since the last message."""
        self._reports.clear()
        end = time.monotonic() + REPORT_S
        while (time.monotonic() < end and not self._reports) or any(
                report.idle < 2 and time.monotonic() - report.arrival_s < REPORT_S
                for report in list(self._reports.values())):
            sleep(0.1)

    def _log_lateness(self) -> None:
        if self._max_lateness_ns > LATENESS_LIMIT_NS:
            _log.warning('up to %.2f s late: the bag could not be read and published at --rate '
                         '%g all the time', self._max_lateness_ns / NANOSECONDS,
                         self._options.rate)


def _time_range(bag: Bag, options: PlayOptions) -> tuple[int, int]:
    """Return the first and last bag time to play [ns]."""
    start_ns = bag.start_ns + round(options.start * NANOSECONDS)
    if start_ns >= bag.end_ns:
        raise KfvoError(f'--start {options.start:g} is after the end of {bag.path}, which lasts '
                        f'{(bag.end_ns - bag.start_ns) / NANOSECONDS:.3f} s')
    if options.duration is None:
        return start_ns, bag.end_ns
    return start_ns, min(bag.end_ns, start_ns + round(options.duration * NANOSECONDS))


def _make_publishers(node: Node, bag: Bag, topics: Iterable[str],
                     publishes_clock: bool) -> dict[str, Publisher]:
    """Return a publisher for each topic that can be published; log the others."""
    publishers = {}
    for topic in topics:
        type_name = bag.topics[topic]
        message_class = find_message_class(type_name)
        recorded_format = bag.wire_format(type_name)
        problem = None
        if publishes_clock and topic == '/clock':
            problem = '--clock publishes there'
        elif message_class is None:
            problem = 'this ROS installation has no such messages'
        elif recorded_format is not None and recorded_format != wire_format(message_class):
            problem = 'this ROS installation has another definition of them'
        else:
            try:
                publishers[topic] = node.create_publisher(message_class, topic, _qos(bag, topic))
            except InvalidTopicNameException:
                problem = 'ROS 2 does not allow the name'
        if problem:
            _log.warning('left out %s (%s): %s', topic, type_name, problem)
    if not publishers:
        raise KfvoError(f'{bag.path}: none of the topics can be published')
    return publishers


def _qos(bag: Bag, topic: str) -> QoSProfile:
    """Return the recorded QoS of a topic's publishers.

    Deadline, lifespan and liveliness are left out: they would not hold at another rate.
    """
    offer = bag.qos_offer(topic)
    reliability = (ReliabilityPolicy.RELIABLE if offer.reliable
                   else ReliabilityPolicy.BEST_EFFORT)
    if offer.latched or topic.endswith('/tf_static'):
        return QoSProfile(depth=min(offer.depth or bag.count(topic), MAX_LATCHED_DEPTH),
                          reliability=reliability, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    return QoSProfile(depth=DEPTH, reliability=reliability)
