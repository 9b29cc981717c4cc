# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real ROS between processes: a domain of this process's own, commands in it, and a listener."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

import kfvo_ros

# Before the first message is imported and the first node made: each reads its part but once.
os.environ.update({
    'ROS_DOMAIN_ID': str(1 + os.getpid() % 100),
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    'ROS_PYTHON_CHECK_FIELDS': '1',  # else a value of a wrong type is sent as nonsense
    'FASTRTPS_DEFAULT_PROFILES_FILE': str(Path(__file__).with_name('fastdds_prompt.xml'))})
rclpy = pytest.importorskip(
    'rclpy', reason="rclpy is not installed: source a ROS 2 or pip install '.[ros]'")

# A sourced ROS is on the path already.
ENVIRONMENT = os.environ | {'PYTHONPATH': os.pathsep.join(
    filter(None, [str(Path(kfvo_ros.__file__).parents[1]), os.environ.get('PYTHONPATH')]))}


def run_module(module: str, *arguments: object, timeout: float = 30.0,
               **options: Any) -> subprocess.CompletedProcess[str]:
    """Run ``python -m module`` in the domain to its end."""
    return subprocess.run([sys.executable, '-m', module, *map(str, arguments)], text=True,
                          capture_output=True, env=ENVIRONMENT, timeout=timeout, **options)


@contextmanager
def running_module(module: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Give ``python -m module``, running in the domain; it does not outlive the ``with``."""
    process = subprocess.Popen([sys.executable, '-m', module, *map(str, arguments)], text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=ENVIRONMENT)
    try:
        yield process
    finally:
        process.terminate()  # killed, it would leave shared memory behind
        try:
            process.communicate(timeout=10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def wait_until(condition: Callable[[], Any], patience: float = 20.0) -> None:
    """Wait until the condition holds; AssertionError when patience [s] is at its end."""
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, 'waited in vain'
        time.sleep(0.02)


class Listener:
    """A node in this process that keeps what comes on some topics, between with and its end.

    ``heard`` holds (time of arrival by time.monotonic [s], topic, message), in order.
    """

    def __init__(self, topics: dict[str, Any], qos: Any = 1000) -> None:
        self.heard: list[tuple[float, str, Any]] = []
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node('listener', context=self._context)
        for topic, message_class in topics.items():
            self.node.create_subscription(message_class, topic, self._keeper(topic), qos)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)

    def __enter__(self) -> Listener:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        self._context.try_shutdown()

    def messages(self, topic: str) -> list[Any]:
        """Return what was heard on a topic."""
        return [message for _, name, message in list(self.heard) if name == topic]

    def arrivals(self, topic: str) -> list[float]:
        """Return when it was heard [s]."""
        return [arrival for arrival, name, _ in list(self.heard) if name == topic]

    def _keeper(self, topic: str) -> Callable[[Any], None]:
        return lambda message: self.heard.append((time.monotonic(), topic, message))
