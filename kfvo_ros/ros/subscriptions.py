# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions: QoS taken from the publishers, lost messages counted, and the calibration."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
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
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import CameraInfo

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.camera import camera_from_info, camera_info_topics, is_rectified
from kfvo_ros.sequences.calibration import read_camera_info
from kfvo_ros.utils.files import find_config

POLL_S = 0.1
"""Period of the search for publishers."""


class QosMatchingSubscription:
    """Subscribes to `topic` once it has publishers, with their type, reliability and durability.

    `types` are the message types that the callback takes, or the only one; `alternatives` are
    topics for where `topic` has no publisher. `reliability` is auto, reliable or best_effort.
    ``lost`` counts the messages that are missing between received ones.
    """

    def __init__(self, node: Node, types: Any, topic: str, depth: int,
                 callback: Callable[[Any], None], reliability: str = 'auto',
                 alternatives: Iterable[str] = ()) -> None:
        self.topic = node.resolve_topic_name(topic)
        self._topics = [self.topic, *map(node.resolve_topic_name, alternatives)]
        self._node, self._callback, self._depth = node, callback, depth
        self._types = {_type_name(each): each
                       for each in (types if isinstance(types, tuple) else (types,))}
        self._gaps = SequenceGapCounter()
        self.lost = 0
        self._reliability = None if reliability == 'auto' else \
            ReliabilityPolicy[reliability.upper()]
        self._subscription: Subscription | None = None
        self._subscribed: tuple[Any, ...] = ()
        self._publishers = 0
        # Not the node's clock: simulated time stands still until /clock is published.
        self._timer = node.create_timer(POLL_S, self._match_publishers,
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def reliability(self) -> str | None:
        """Reliability of the subscription: reliable, best_effort, or None without one."""
        if self._subscription is None:
            return None
        return str(self._subscription.qos_profile.reliability.name).lower()

    def problem(self) -> str:
        """Return why no message may come, with the remedy; empty if no reason is known."""
        names = ' or '.join(self._types)
        types = dict(self._node.get_topic_names_and_types())
        if self._node.count_publishers(self.topic) == 0:
            others = sorted(topic for topic, found in types.items()
                            if self._types.keys() & found and topic != self.topic)
            return (f'{self.topic} has no publisher; '
                    + (f'topics of that type: {", ".join(others)}' if others
                       else f'there is no topic of type {names} at all'))
        wrong = [each for each in types.get(self.topic, []) if each not in self._types]
        return f'{self.topic} carries {", ".join(wrong)}, expected {names}' if wrong else ''

    def publishers(self) -> list[str]:
        """Return the nodes that publish messages on the topic, one for each publisher."""
        return [f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                for info in self._offers(self.topic)]

    def _offers(self, topic: str) -> list[TopicEndpointInfo]:
        """Return the publishers of a topic whose type is right."""
        return [info for info in self._node.get_publishers_info_by_topic(topic)
                if info.topic_type in self._types]

    def _match_publishers(self) -> None:
        """Subscribe like the publishers; one best-effort publisher makes it best effort."""
        topic = next((topic for topic in self._topics if self._offers(topic)), None)
        if topic is None:
            return
        offers = self._offers(topic)
        name = next(each for each in self._types if any(
            info.topic_type == each for info in offers))
        offered = [info.qos_profile for info in offers if info.topic_type == name]
        wanted = (topic, name, *self._policies(offered))
        if wanted == self._subscribed:
            if self._publishers:  # else the camera has gone, and another may come
                self._timer.cancel()
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self.topic, self._subscribed = topic, wanted
        self._subscribe(*wanted)
        how = f'{self.reliability}, as its {"publisher" if len(offered) == 1 else "publishers"}' \
            if self._reliability is None else self.reliability
        self._node.get_logger().info(f'subscribed to {topic} ({how})')

    def _policies(self, offered: list[QoSProfile]) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
        """Return reliability and durability that all publishers offer, or as requested."""
        if self._reliability is not None:
            return self._reliability, DurabilityPolicy.VOLATILE
        reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
        latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
        return (ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
                DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)

    def _subscribe(self, topic: str, type_name: str, reliability: ReliabilityPolicy,
                   durability: DurabilityPolicy) -> None:
        qos = QoSProfile(depth=self._depth, history=HistoryPolicy.KEEP_LAST,
                         reliability=reliability, durability=durability)
        self._gaps, self._publishers = SequenceGapCounter(), 0
        on_message: Callable[..., None] = self._on_message  # rclpy's types lack its 2nd argument
        self._subscription = self._node.create_subscription(
            self._types[type_name], topic, on_message, qos,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible_qos,
                                                       matched=self._on_matched))

    def _on_message(self, message: Any, info: dict[str, Any]) -> None:
        self.lost += self._gaps.missing_before(info['publication_sequence_number'])
        self._callback(message)

    def _on_matched(self, event: QoSSubscriptionMatchedInfo) -> None:
        """Handle a publisher that came, which rclpy reports before its first message, or went."""
        self._publishers = event.current_count
        if event.total_count_change > 0:
            self._gaps.reset(event.current_count)
        if event.current_count == 0:
            self._timer.reset()  # the next publisher may be of another type

    def _on_incompatible_qos(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        """Subscribe again with what the publishers offer, or log the remedy."""
        policy = QoSPolicyKind(event.last_policy_kind).name.lower()
        if self._reliability is not None:
            self._node.get_logger().error(
                f'a publisher of {self.topic} does not offer the requested {policy}, so nothing '
                'is received from it: set image_qos to auto or best_effort')
            return
        self._node.get_logger().warning(
            f'a publisher of {self.topic} offers another {policy}: subscribing again')
        self._timer.reset()  # not here, while the executor serves this subscription


class SequenceGapCounter:
    """Counts gaps in the sequence numbers of one subscription's messages.

    The message-lost event of ROS 2 covers what the transport lost, not what newer messages
    pushed out of a full queue; gaps show both. rclpy does not report which of several publishers
    sent a message. It need not: whichever of them a number is assigned to, the gaps have the
    same sum.
    """

    def __init__(self) -> None:
        self._publishers = 0
        self._last: list[int] = []

    def reset(self, publishers: int) -> None:
        """Forget all numbers: one of `publishers` is new, and its numbers start anywhere."""
        self._publishers = publishers
        self._last.clear()

    def missing_before(self, number: int | None) -> int:
        """Return the number of messages missing before `number`.

        Zero for None, which some DDS report, and for what precedes a publisher's first message.
        """
        if number is None:
            return 0
        last = max((each for each in self._last if each < number), default=None)
        if last is None or (number - last > 1 and len(self._last) < self._publishers):
            self._last.append(number)
            return 0
        self._last[self._last.index(last)] = number
        return number - last - 1


class CameraSource:
    """Calibration of the images of `image_topic`, from a file or a CameraInfo topic.

    A `file`, also one of config/ by its name, takes precedence over `info_topic`, which defaults
    to camera_info beside the images, or where else drivers publish it. A rectified topic's
    camera is P of its CameraInfo. Raises KfvoError for a file that is not a calibration.
    """

    def __init__(self, node: Node, image_topic: str, info_topic: str = '',
                 file: str = '') -> None:
        self._rectified = is_rectified(image_topic)
        self._info: CameraInfo | None = None
        self._received = threading.Event()
        self._file_camera = read_camera_info(find_config(file), self._rectified) if file else None
        self._file = file
        self._subscription: QosMatchingSubscription | None = None
        if self._file_camera is None:
            first, *others = [info_topic] if info_topic else camera_info_topics(image_topic)
            self._subscription = QosMatchingSubscription(node, CameraInfo, first, 1,
                                                         self._on_info, alternatives=others)

    @property
    def name(self) -> str:
        """The file, or the topic."""
        return self._file if self._subscription is None else self._subscription.topic

    def wait(self, seconds: float) -> None:
        """Wait up to `seconds` for the first CameraInfo of a topic that has publishers.

        It may arrive before or after the image it was sent with.
        """
        if self._subscription is not None and self._subscription.reliability is not None:
            self._received.wait(seconds)

    def camera(self, width: int, height: int) -> Camera | None:
        """Return the camera of images of this size, None before there is a calibration.

        A calibration of another size is scaled. Raises KfvoError when its aspect ratio differs.
        """
        try:
            camera = self._file_camera if self._info is None else \
                camera_from_info(self._info, self._rectified, width, height)
            return None if camera is None else camera.scaled(width, height)
        except KfvoError as error:
            raise KfvoError(f'{"CameraInfo on " if self._info else ""}{self.name}: '
                            f'{error}') from error

    def problem(self) -> str:
        """Return why there is no calibration, and both remedies."""
        why = f'no calibration on {self.name}' if self._info is None else \
            f'the CameraInfo on {self.name} says uncalibrated (fx = 0)'
        return (f'{why}: publish a calibrated CameraInfo there (or set camera_info_topic), or set '
                'camera_info_file to a camera_info.yaml')

    def _on_info(self, info: CameraInfo) -> None:
        self._info = info
        self._received.set()


def _type_name(message_type: Any) -> str:
    """Return a type's name, like sensor_msgs/msg/Image."""
    package, folder, _ = message_type.__module__.split('.', 2)
    return f'{package}/{folder}/{message_type.__name__}'
