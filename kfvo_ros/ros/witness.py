# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Listen to a running kfvo_node, as its users do."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from kfvo_ros.ros.messages import to_stamp_ns


class Witness(Node):
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
