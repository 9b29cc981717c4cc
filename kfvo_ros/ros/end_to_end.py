# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Listen to a running kfvo_node, as its users do."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from kfvo_ros.errors import KfvoError
from kfvo_ros.ros.messages import to_stamp_ns
from kfvo_ros.utils.process import signals_blocked

if TYPE_CHECKING:
    pass


SETTLED_S, PATIENCE_S = 1.5, 60.0
"""Without a new pose for so long the node has caught up; it is waited for so long at most."""
STOP_S = 5.0


class NodeListener(Node):
    """Keeps what the node of this `name` says.

    ``stamps_ns`` of its poses, ``keyframes_ns`` of those kept, ``values`` of its last diagnostics,
    and ``memory_mb`` it used [MiB], each second.
    """

    def __init__(self, name: str = '/kfvo') -> None:
        super().__init__('kfvo_witness', start_parameter_services=False)
        self.stamps_ns: list[int] = []
        self.keyframes_ns: list[int] = []
        self.values: dict[str, str] = {}
        self.memory_mb: list[float] = []
        self._last = time.monotonic()
        self.create_subscription(Odometry, f'{name}/odometry', self._on_odometry, 1000)
        self.create_subscription(PoseStamped, f'{name}/keyframe', self._on_keyframe, 1000)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def await_silence(self, seconds: float, patience: float) -> None:
        """Return once no pose has come for so long; wait `patience` [s] at most."""
        end = time.monotonic() + patience
        while time.monotonic() < end and time.monotonic() - self._last < seconds:
            time.sleep(0.1)

    def _on_odometry(self, message: Odometry) -> None:
        self._last = time.monotonic()
        self.stamps_ns.append(to_stamp_ns(message.header.stamp))

    def _on_keyframe(self, message: PoseStamped) -> None:
        self.keyframes_ns.append(to_stamp_ns(message.header.stamp))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(': odometry'):
                self.values = {value.key: value.value for value in status.values}
                self.memory_mb.append(float(self.values['memory [MiB]']))


@dataclass(frozen=True)
class NodeRun:
    """What a node said from its start to its end; latencies from an image's arrival [ms].

    Of its images, `missed` were lost before it, and `dropped` of the `received` by itself. It used
    `memory_mb` [MiB], each second.
    """

    stamps_ns: list[int]
    keyframes_ns: list[int]
    missed: int
    received: int
    dropped: int
    latency_median_ms: float
    latency_p95_ms: float
    memory_mb: list[float]


def run_node(bag: Path, topic: str, parameters: dict[str, object], rate: float = 1.0) -> NodeRun:
    """Play the images of a bag and their CameraInfo to a node with these parameters.

    Raises KfvoError when one of the two ends early.
    """
    # Of its own, so that no other robot in the network hears or disturbs it.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    with signals_blocked():
        from kfvo_ros.ros.runtime import spinning_node
        pass
    choices = {'image_topic': topic, **parameters}
    given = [text for name, value in choices.items() for text in ('-p', f'{name}:={value}')]
    with spinning_node(NodeListener, []) as witness, subprocess.Popen(
            [sys.executable, '-m', 'kfvo_ros.node', '--ros-args', *given]) as node:
        try:
            _await_node(witness, node)
            player = subprocess.run(
                [sys.executable, '-m', 'kfvo_ros.play', str(bag), '--rate', str(rate), '--topic',
                 topic, '--topic', f'{topic.rpartition("/")[0]}/camera_info',
                 '--wait-for-subscribers'])
            witness.await_silence(SETTLED_S, PATIENCE_S)
        finally:
            node.terminate()
            try:
                node.wait(STOP_S)
            except subprocess.TimeoutExpired:
                node.kill()
    values = witness.values
    if player.returncode != 0 or node.returncode != 0 or 'images received' not in values:
        raise KfvoError(f'kfvo_play ended with status {player.returncode} and kfvo_node with '
                        f'{node.returncode}; expected 0 of both and diagnostics')
    missed, received, dropped = (int(values[f'images {what}'])
                                 for what in ('lost in transit', 'received', 'dropped'))
    return NodeRun(witness.stamps_ns, witness.keyframes_ns, missed, received, dropped,
                   float(values['latency median [ms]']), float(values['latency 95 % [ms]']),
                   witness.memory_mb)


def _await_node(witness: NodeListener, node: subprocess.Popen[bytes]) -> None:
    """Return when the witness hears the node, so that it misses no pose; raises KfvoError."""
    end = time.monotonic() + PATIENCE_S
    while not witness.values:
        if node.poll() is not None or time.monotonic() > end:
            raise KfvoError('kfvo_node does not run; what it says is above')
        time.sleep(0.05)
