# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bag time against the clock on the wall."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from itertools import count

from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from tqdm import tqdm

from kfvo_ros.errors import KfvoError
from kfvo_ros.ros.messages import find_message_class, message_layout
from kfvo_ros.ros.options import PlayOptions
from kfvo_ros.ros.worker import ReadAhead
from kfvo_ros.sequences.bag.reader import Bag
from kfvo_ros.trajectory import NANOSECONDS

READ_AHEAD_BYTES = 16 * 1024 * 1024
DISCOVERY_S = 3.5
"""How long subscribers that run already may take to be found: Fast DDS announces every 3 s."""
SETTLING_S = 0.2
"""From when a publisher has found its subscribers to when they have found it."""
REMINDER_S = 5.0
ACKNOWLEDGEMENT_S = 5.0
"""Fast DDS asks its readers what they have every 3 s."""
DEPTH = 10
"""Of what is not latched, whatever was recorded: with Fast DDS a deeper queue delays all later
messages by seconds where one was lost, to send it again."""
LATCHED_DEPTH = 100
LATE_NS = 50_000_000
"""What is less late is not worth a word."""
LOOP_GAP_S = 0.1
"""Between loops, so that a bag of one message does not become a flood."""
BAR = '{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s of the bag'
_log = logging.getLogger(__name__)


class PlaybackClock:
    """Lets bag time pass at a rate; what is late is not waited for, and delays nothing after it.

    `tick` is called with the bag time [ns], `frequency` times a second, during the waits.
    """

    def __init__(self, rate: float, tick: Callable[[int], None] | None = None,
                 frequency: float = 1.0) -> None:
        self._rate, self._tick = rate, tick
        self._period_ns = round(NANOSECONDS / frequency)
        self.begin(0)

    def begin(self, bag_time_ns: int) -> None:
        """Let it be `bag_time_ns` now."""
        self._from_ns = bag_time_ns
        self._began_ns = self._next_tick_ns = time.monotonic_ns()

    def wait_for(self, bag_time_ns: int) -> int:
        """Sleep until it is `bag_time_ns`; return how late it is by then [ns]."""
        due_ns = self._began_ns + round((bag_time_ns - self._from_ns) / self._rate)
        while True:
            now_ns = time.monotonic_ns()
            wake_ns = due_ns
            if self._tick is not None:
                if now_ns >= self._next_tick_ns:
                    self._tick(self._from_ns + round((now_ns - self._began_ns) * self._rate))
                    missed = (now_ns - self._next_tick_ns) // self._period_ns
                    self._next_tick_ns += (missed + 1) * self._period_ns
                wake_ns = min(due_ns, self._next_tick_ns)
            if now_ns >= due_ns:
                return now_ns - due_ns
            time.sleep(max(wake_ns - now_ns, 0) / NANOSECONDS)


def make_node() -> Node:
    """Return the node of a player, which has no parameters to speak of."""
    return Node('kfvo_play', start_parameter_services=False)


class Player:
    """Publishes topics of an open bag by their recorded times; nothing is left out when late.

    ``count`` is the number of messages published, ``seconds`` how far into the bag that is, from
    where it was to start.
    """

    def __init__(self, node: Node, bag: Bag, topics: Iterable[str], options: PlayOptions) -> None:
        self._bag, self._options = bag, options
        self._start_ns, self._stop_ns = _window(bag, options)
        self._publishers = _make_publishers(node, bag, topics, options.clock is not None)
        if options.clock is None:
            self._pacing = PlaybackClock(options.rate)
        else:
            self._clock = node.create_publisher(Clock, '/clock', 10)
            self._pacing = PlaybackClock(options.rate, self._publish_clock, options.clock)
        self._latest_ns = 0
        self.count, self.seconds = 0, 0.0

    def play(self) -> None:
        """Play the bag, endlessly when it is to loop; KfvoError where the bag is damaged."""
        self._await_subscribers()
        name = self._bag.path.name
        try:
            with tqdm(total=(self._stop_ns - self._start_ns) / NANOSECONDS, desc=name,
                      bar_format=BAR) as bar:
                self._play_once(bar)
                for loop in count(2) if self._options.loop else ():
                    time.sleep(LOOP_GAP_S)
                    bar.reset()
                    bar.set_description(f'{name}, loop {loop}')
                    self._play_once(bar)
        finally:
            self._tell_lateness()
        self._await_acknowledgements()

    def _play_once(self, bar: tqdm) -> None:
        """Publish the messages, from the first to the last; KfvoError when there are none."""
        began = False
        messages = self._bag.raw_messages(self._publishers, self._start_ns, self._stop_ns)
        with ReadAhead(messages, lambda message: len(message[2]), READ_AHEAD_BYTES) as ahead:
            for topic, bag_time_ns, cdr in ahead:
                if not began:
                    self._pacing.begin(self._start_ns)
                    began = True
                late_ns = self._pacing.wait_for(bag_time_ns)
                self._publishers[topic].publish(cdr)
                self._latest_ns = max(self._latest_ns, late_ns)
                self.count += 1
                self.seconds = (bag_time_ns - self._start_ns) / NANOSECONDS
                bar.update(self.seconds - bar.n)
        if not began:
            raise KfvoError(f'{self._bag.path} has no message on {", ".join(self._publishers)} '
                            'within what --start and --duration select')

    def _publish_clock(self, bag_time_ns: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(bag_time_ns, NANOSECONDS)
        self._clock.publish(message)

    def _await_subscribers(self) -> None:
        """Wait for those asked for, or briefly for those that run already."""
        wanted, images = self._options.wait_for_subscribers, set(self._bag.image_topics())
        awaited = {topic: publisher for topic, publisher in self._publishers.items()
                   if topic in images} or self._publishers
        began = reminded = time.monotonic()
        while lacking := [publisher.topic_name for publisher in awaited.values()
                          if publisher.get_subscription_count() < (wanted or 1)]:
            now = time.monotonic()
            if wanted is None and now - began > DISCOVERY_S:
                _log.info('playing, though nobody listens to %s yet', ', '.join(lacking))
                return
            if now - reminded > REMINDER_S:
                reminded = now
                _log.info('waiting for %s on %s', 'a subscriber' if wanted == 1 else
                          f'{wanted} subscribers', ', '.join(lacking))
            time.sleep(0.02)
        time.sleep(SETTLING_S)

    def _await_acknowledgements(self) -> None:
        """Wait, within reason, until reliable subscribers have the last messages."""
        end = time.monotonic() + ACKNOWLEDGEMENT_S
        for publisher in self._publishers.values():
            while not publisher.wait_for_all_acked(Duration(seconds=0.05)):
                if time.monotonic() > end:
                    _log.warning('a subscriber of %s did not confirm the last messages',
                                 publisher.topic_name)
                    return

    def _tell_lateness(self) -> None:
        if self._latest_ns > LATE_NS:
            _log.warning('up to %.2f s late: the bag could not be read and published at --rate '
                         '%g all the time', self._latest_ns / NANOSECONDS, self._options.rate)


def _window(bag: Bag, options: PlayOptions) -> tuple[int, int]:
    """Return the bag times [ns] between which to play."""
    start_ns = bag.start_ns + round(options.start * NANOSECONDS)
    if start_ns >= bag.end_ns:
        raise KfvoError(f'--start {options.start:g} is after the end of {bag.path}, which lasts '
                        f'{(bag.end_ns - bag.start_ns) / NANOSECONDS:.3f} s')
    if options.duration is None:
        return start_ns, bag.end_ns
    return start_ns, min(bag.end_ns, start_ns + round(options.duration * NANOSECONDS))


def _make_publishers(node: Node, bag: Bag, topics: Iterable[str],
                     own_clock: bool) -> dict[str, Publisher]:
    """Return a publisher for each topic that can be published, telling about the others."""
    publishers = {}
    for topic in topics:
        kind = bag.topics[topic]
        message_class = find_message_class(kind)
        layout = bag.layout(kind)
        problem = None
        if own_clock and topic == '/clock':
            problem = '--clock publishes there'
        elif message_class is None:
            problem = 'this ROS installation has no such messages'
        elif layout is not None and layout != message_layout(message_class):
            problem = 'this ROS installation has another definition of them'
        else:
            try:
                publishers[topic] = node.create_publisher(message_class, topic, _qos(bag, topic))
            except InvalidTopicNameException:
                problem = 'ROS 2 does not allow the name'
        if problem:
            _log.warning('left out %s (%s): %s', topic, kind, problem)
    if not publishers:
        raise KfvoError(f'{bag.path}: none of the topics can be published')
    return publishers


def _qos(bag: Bag, topic: str) -> QoSProfile:
    """Return what the topic's publishers offered when it was recorded.

    Not so deadline, lifespan and liveliness: they would not hold at another rate.
    """
    delivery = bag.delivery(topic)
    reliability = (ReliabilityPolicy.RELIABLE if delivery.reliable
                   else ReliabilityPolicy.BEST_EFFORT)
    if delivery.latched or topic.endswith('/tf_static'):
        return QoSProfile(depth=min(delivery.depth or bag.count(topic), LATCHED_DEPTH),
                          reliability=reliability, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    return QoSProfile(depth=DEPTH, reliability=reliability)
