# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions: QoS taken from the publishers, lost messages counted, and the calibration."""

from __future__ import annotations

import threading
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
from sensor_msgs.msg import CameraInfo

from kfvo_ros.camera import Camera, read_camera_info
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.camera import camera_from_info, camera_info_topic, is_rectified
from kfvo_ros.utils.files import find_config

POLL_S = 0.1
"""Period of the search for publishers."""


class QosMatchingSubscription:
    """Subscribes to `topic` once it has publishers, with their reliability and durability.

    `reliability` is auto, reliable or best_effort; the last two subscribe at once. ``lost``
    counts the messages that are missing between received ones.
    """

    def __init__(self, node: Node, message_type: Any, topic: str, depth: int,
                 callback: Callable[[Any], None], reliability: str = 'auto') -> None:
        self.topic = node.resolve_topic_name(topic)
        self._node, self._type, self._callback = node, message_type, callback
        self._depth = depth
        self._gaps = SequenceGapCounter()
        self.lost = 0
        self._auto = reliability == 'auto'
        self._subscription: Subscription | None = None
        if self._auto:
            # Not the node's clock: simulated time stands still until /clock is published.
            self._timer = node.create_timer(POLL_S, self._match_publishers,
                                            clock=Clock(clock_type=ClockType.STEADY_TIME))
        else:
            self._subscribe(ReliabilityPolicy[reliability.upper()], DurabilityPolicy.VOLATILE)

    @property
    def reliability(self) -> str | None:
        """Reliability of the subscription: reliable, best_effort, or None without one."""
        if self._subscription is None:
            return None
        return str(self._subscription.qos_profile.reliability.name).lower()

    def problem(self) -> str:
        """Return why no message may come, with the remedy; empty if no reason is known."""
        name = _type_name(self._type)
        types = dict(self._node.get_topic_names_and_types())
        found = [other for other in types.get(self.topic, []) if other != name]
        if self._node.count_publishers(self.topic) == 0:
            others = sorted(topic for topic, names in types.items()
                            if name in names and topic != self.topic)
            return (f'{self.topic} has no publisher; '
                    + (f'topics of that type: {", ".join(others)}' if others
                       else f'there is no topic of type {name} at all'))
        if found:
            return f'{self.topic} carries {", ".join(found)}, expected {name}'
        return ''

    def _match_publishers(self) -> None:
        """Subscribe like the publishers; one best-effort publisher makes it best effort."""
        publishers = [info for info in self._node.get_publishers_info_by_topic(self.topic)
                      if info.topic_type == _type_name(self._type)]
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
        self._gaps = SequenceGapCounter()
        on_message: Callable[..., None] = self._on_message  # rclpy's types lack its 2nd argument
        self._subscription = self._node.create_subscription(
            self._type, self.topic, on_message, qos,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible_qos,
                                                       matched=self._on_matched))

    def _on_message(self, message: Any, info: dict[str, Any]) -> None:
        self.lost += self._gaps.missing_before(info['publication_sequence_number'])
        self._callback(message)

    def _on_matched(self, event: QoSSubscriptionMatchedInfo) -> None:
        """Handle a new publisher; rclpy reports it before its first message."""
        if event.total_count_change > 0:
            self._gaps.reset(event.current_count)

    def _on_incompatible_qos(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        """Subscribe again with what the publishers offer, or log the remedy."""
        policy = QoSPolicyKind(event.last_policy_kind).name.lower()
        if not self._auto:
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
    to camera_info beside the images. A rectified topic's camera is P of its CameraInfo. Raises
    KfvoError for a file that is not a calibration.
    """

    def __init__(self, node: Node, image_topic: str, info_topic: str = '',
                 file: str = '') -> None:
        self._rectified = is_rectified(image_topic)
        self._info: CameraInfo | None = None
        self._received = threading.Event()
        self._file_camera = read_camera_info(find_config(file)) if file else None
        self._subscription = None
        self.name = file
        if self._file_camera is None:
            self._subscription = QosMatchingSubscription(
                node, CameraInfo, info_topic or camera_info_topic(image_topic), 1, self._on_info)
            self.name = self._subscription.topic

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
        camera = self._file_camera
        if self._info is not None:
            try:
                camera = camera_from_info(self._info, self._rectified, width, height)
            except KfvoError as error:
                raise KfvoError(f'CameraInfo on {self.name}: {error}') from error
        return None if camera is None else camera.scaled(width, height)

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
