# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What was lost before a subscription's callback, from the numbers its messages carry.

The message-lost event of ROS 2 knows of what the transport lost, not of what newer messages
pushed out of a full queue. The numbers that publishers give their messages show both.
"""

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
"""How often to look for a publisher."""
WAITING = 'waiting'
"""The reliability of no subscription yet."""


class SequenceGapCounter:
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


class QosMatchingSubscription:
    """Subscribes to `topic` as soon as somebody publishes it, as reliably as they do.

    `reliability` is auto, reliable or best_effort; the last two subscribe at once. ``lost``
    counts the messages that did not come between others that did.
    """

    def __init__(self, node: Node, message_type: Any, topic: str, depth: int,
                 callback: Callable[[Any], None], reliability: str = 'auto') -> None:
        self.topic = node.resolve_topic_name(topic)
        self._node, self._type, self._callback = node, message_type, callback
        self._depth = depth
        self._numbering = SequenceGapCounter()
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
        self._numbering = SequenceGapCounter()
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


class CameraSource:
    """The calibration of the images of `image_topic`; nothing is ever guessed.

    A `file`, also one of config/ by its name, wins over the `info_topic`, which is by default
    beside the images. Of a rectified topic's CameraInfo, P is taken. Raises KfvoError for a
    file that is none.
    """

    def __init__(self, node: Node, image_topic: str, info_topic: str = '',
                 file: str = '') -> None:
        self._rectified = is_rectified(image_topic)
        self._info: CameraInfo | None = None
        self._came = threading.Event()
        self._fixed = read_camera_info(find_config(file)) if file else None
        self._following = None
        self.name = file
        if self._fixed is None:
            self._following = QosMatchingSubscription(node, CameraInfo,
                                                      info_topic or camera_info_topic(image_topic), 1,
                                                      self._keep)
            self.name = self._following.topic

    def wait(self, seconds: float) -> None:
        """Wait so long at most for the first CameraInfo where one is to come.

        It may overtake, or be overtaken by, the image it was sent with.
        """
        if self._following is not None and self._following.reliability != WAITING:
            self._came.wait(seconds)

    def camera(self, width: int, height: int) -> Camera | None:
        """Return the camera of images of this size, None before there is a calibration.

        Raises KfvoError when the calibration cannot be that of such images.
        """
        camera = self._fixed
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

    def _keep(self, info: CameraInfo) -> None:
        self._info = info
        self._came.set()
