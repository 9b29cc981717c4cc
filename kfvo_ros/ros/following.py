# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A subscription with the quality of service that the publisher offers.

rclpy's BEST_AVAILABLE is decided once, when the subscription is made: a node that starts before
its camera would ask for reliable messages for ever and get none from a best-effort camera.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import (
    QoSRequestedIncompatibleQoSInfo,
    QoSSubscriptionMatchedInfo,
    SubscriptionEventCallbacks,
)
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.subscription import Subscription

from kfvo_ros.ros.numbering import Numbering

POLL_S = 0.1
"""How often to look for a publisher."""
WAITING = 'waiting'
"""The reliability of no subscription yet."""


class Following:
    """Subscribes to `topic` as soon as somebody publishes it, as reliably as they do.

    `reliability` is auto, reliable or best_effort; the last two subscribe at once. ``lost``
    counts the messages that did not come between others that did.
    """

    def __init__(self, node: Node, message_type: Any, topic: str, depth: int,
                 callback: Callable[[Any], None], reliability: str = 'auto') -> None:
        self.topic = node.resolve_topic_name(topic)
        self._node, self._type, self._callback = node, message_type, callback
        self._depth = depth
        self._numbering = Numbering()
        self.lost = 0
        self._auto = reliability == 'auto'
        self._subscription: Subscription | None = None
        if self._auto:
            # Not the node's clock: simulated time stands still until somebody publishes it.
            self._timer = node.create_timer(POLL_S, self._follow,
                                            clock=Clock(clock_type=ClockType.STEADY_TIME))
        else:
            self._subscribe(ReliabilityPolicy[reliability.upper()], DurabilityPolicy.VOLATILE)

    @property
    def reliability(self) -> str:
        """What was subscribed with: reliable, best_effort, or WAITING."""
        if self._subscription is None:
            return WAITING
        return str(self._subscription.qos_profile.reliability.name).lower()

    def problem(self) -> str:
        """Return why nothing may come, with what to do; empty where all looks well."""
        name = _name_of(self._type)
        types = dict(self._node.get_topic_names_and_types())
        found = [kind for kind in types.get(self.topic, []) if kind != name]
        if self._node.count_publishers(self.topic) == 0:
            others = sorted(topic for topic, kinds in types.items()
                            if name in kinds and topic != self.topic)
            return (f'nobody publishes {self.topic}; '
                    + (f'topics of that type: {", ".join(others)}' if others
                       else f'there is no topic of type {name} at all'))
        if found:
            return f'{self.topic} carries {", ".join(found)}, expected {name}'
        return ''

    def _follow(self) -> None:
        """Subscribe like the publishers; one best-effort publisher makes it best effort."""
        publishers = [info for info in self._node.get_publishers_info_by_topic(self.topic)
                      if info.topic_type == _name_of(self._type)]
        if not publishers:
            return
        self._timer.cancel()
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        offered = [info.qos_profile for info in publishers]
        reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
        latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
        self._subscribe(
            ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)
        self._node.get_logger().info(f'subscribed to {self.topic} ({self.reliability}, as its '
                                     f'{"publisher" if len(offered) == 1 else "publishers"})')

    def _subscribe(self, reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> None:
        qos = QoSProfile(depth=self._depth, history=HistoryPolicy.KEEP_LAST,
                         reliability=reliability, durability=durability)
        self._numbering = Numbering()
        receive: Callable[..., None] = self._receive  # whose second argument rclpy's types lack
        self._subscription = self._node.create_subscription(
            self._type, self.topic, receive, qos,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._incompatible,
                                                       matched=self._matched))

    def _receive(self, message: Any, info: dict[str, Any]) -> None:
        self.lost += self._numbering.missing(info['publication_sequence_number'])
        self._callback(message)

    def _matched(self, event: QoSSubscriptionMatchedInfo) -> None:
        """A publisher came or went; of one that came, this is told before its messages."""
        if event.total_count_change > 0:
            self._numbering.begin(event.current_count)

    def _incompatible(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        """A publisher offers less than was asked for: ask for less, or tell how to."""
        policy = QoSPolicyKind(event.last_policy_kind).name.lower()
        if not self._auto:
            self._node.get_logger().error(
                f'a publisher of {self.topic} does not offer the {policy} that was asked for, so '
                'nothing comes from it: set image_qos to auto or best_effort')
            return
        self._node.get_logger().warning(
            f'a publisher of {self.topic} offers another {policy}: subscribing anew')
        self._timer.reset()  # not here, where the subscription is being served


def _name_of(message_type: Any) -> str:
    """Return a type's name, like sensor_msgs/msg/Image."""
    package, folder, _ = message_type.__module__.split('.', 2)
    return f'{package}/{folder}/{message_type.__name__}'
