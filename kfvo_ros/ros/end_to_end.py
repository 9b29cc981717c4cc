# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""End-to-end runs: kfvo_node and kfvo_play in processes of their own over DDS, and a listener."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from kfvo_ros.errors import KfvoError
from kfvo_ros.ros.messages import to_stamp_ns
from kfvo_ros.ros.runtime import spinning_node
from kfvo_ros.utils.process import time_limit
from kfvo_ros.utils.signals import sleep

QUIET_S = 1.5
"""Without a new pose for this long the node has processed all images."""
TIMEOUT_S = 60.0
"""Longest wait for the node to start, and for it to process all images, on a free machine. It
suffices for compilation where no cache is writable."""
STOP_S = 5.0
"""Longest wait for the node to stop before it is killed, on a free machine."""


@dataclass(frozen=True)
class NodeRun:
    """Result of one run of the node; latencies are from an image's arrival to its pose [ms].

    ``stamps_ns`` of the poses, ``keyframes_ns`` of the keyframes. ``lost_in_transit`` images never
    reached the node; it dropped ``dropped`` of the ``received``. ``memory_mb`` is the node's
    resident memory [MiB], once per second.
    """

    stamps_ns: list[int]
    keyframes_ns: list[int]
    lost_in_transit: int
    received: int
    dropped: int
    latency_median_ms: float
    latency_p95_ms: float
    memory_mb: list[float]


class NodeListener(Node):
    """Collects the outputs of the node called `name`.

    ``stamps_ns`` of its poses, ``keyframes_ns`` of its keyframes, ``values`` of its last
    diagnostics, ``memory_mb`` its resident memory [MiB], once per second.
    """

    def __init__(self, name: str = '/kfvo') -> None:
        super().__init__('kfvo_listener', start_parameter_services=False)
        self.stamps_ns: list[int] = []
        self.keyframes_ns: list[int] = []
        self.values: dict[str, str] = {}
        self.memory_mb: list[float] = []
        self._last_pose = time.monotonic()
        self.create_subscription(Odometry, f'{name}/odometry', self._on_odometry, 1000)
        self.create_subscription(PoseStamped, f'{name}/keyframe', self._on_keyframe, 1000)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def wait_until_quiet(self, quiet_s: float, timeout_s: float) -> None:
        """Return once no pose has come for `quiet_s`, at the latest after `timeout_s`."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end and time.monotonic() - self._last_pose < quiet_s:
            sleep(0.1)

    def _on_odometry(self, message: Odometry) -> None:
        self._last_pose = time.monotonic()
        self.stamps_ns.append(to_stamp_ns(message.header.stamp))

    def _on_keyframe(self, message: PoseStamped) -> None:
        self.keyframes_ns.append(to_stamp_ns(message.header.stamp))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(': odometry'):
                self.values = {value.key: value.value for value in status.values}
                self.memory_mb.append(float(self.values['memory [MiB]']))


def run_node(bag: Path, topic: str, parameters: dict[str, object], rate: float = 1.0) -> NodeRun:
    """Run a node with `parameters` on the images of a bag's topic and their CameraInfo.

    The bag plays at `rate` times real time. Raises KfvoError when node or player fails.
    """
    # Its own domain: other robots in the network neither receive nor disturb it.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    arguments = [text for name, value in {'image_topic': topic, **parameters}.items()
                 for text in ('-p', f'{name}:={value}')]
    with spinning_node(NodeListener, []) as listener, subprocess.Popen(
            [sys.executable, '-m', 'kfvo_ros.node', '--ros-args', *arguments]) as node:
        try:
            _await_node(listener, node)
            with subprocess.Popen(
                    [sys.executable, '-m', 'kfvo_ros.play', str(bag), '--rate', str(rate),
                     '--topic', topic, '--topic', f'{topic.rpartition("/")[0]}/camera_info',
                     '--wait-for-subscribers']) as player:
                _await_player(player)
            listener.wait_until_quiet(QUIET_S, time_limit(TIMEOUT_S))
        finally:
            node.terminate()
            try:
                node.wait(time_limit(STOP_S))
            except subprocess.TimeoutExpired:
                node.kill()
    if player.returncode != 0 or node.returncode != 0 or 'images received' not in listener.values:
        raise KfvoError(f'kfvo_play ended with status {player.returncode} and kfvo_node with '
                        f'{node.returncode}; expected 0 of both and diagnostics')
    return _collect(listener)


def _await_node(listener: NodeListener, node: subprocess.Popen[bytes]) -> None:
    """Return once the node's diagnostics arrive, so that no pose is missed; raises KfvoError."""
    end = time.monotonic() + time_limit(TIMEOUT_S)
    while not listener.values:
        if node.poll() is not None or time.monotonic() > end:
            raise KfvoError('kfvo_node does not run; its output is above')
        sleep(0.05)


def _await_player(player: subprocess.Popen[bytes]) -> None:
    """Return once the player has ended; end it after a signal."""
    try:
        while player.poll() is None:
            sleep(0.05)
    finally:
        player.terminate()


def _collect(listener: NodeListener) -> NodeRun:
    """Return the listener's records as a result."""
    values = listener.values
    lost_in_transit, received, dropped = (
        int(values[f'images {count}']) for count in ('lost in transit', 'received', 'dropped'))
    return NodeRun(listener.stamps_ns, listener.keyframes_ns, lost_in_transit, received, dropped,
                   float(values['latency median [ms]']), float(values['latency 95 % [ms]']),
                   listener.memory_mb)
