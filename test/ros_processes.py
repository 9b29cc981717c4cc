# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real ROS between processes: an own domain, commands in it, and a listening node."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest
from command_lines import run_python, started

import kfvo_ros
from kfvo_ros.utils.process import time_limit

# Set before the first import of a message and the first node: each is read once.
os.environ.update({
    'ROS_DOMAIN_ID': str(1 + os.getpid() % 100),
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    'ROS_PYTHON_CHECK_FIELDS': '1',  # else rclpy sends a value of a wrong type as garbage
    'FASTRTPS_DEFAULT_PROFILES_FILE': str(Path(__file__).with_name('fastdds_prompt.xml'))})
rclpy = pytest.importorskip(
    'rclpy', reason="rclpy is not installed: source a ROS 2 or pip install '.[ros]'")

def environment(*folders: Path) -> dict[str, str]:
    """Return this process's environment with `folders` and kfvo_ros first in the import path.

    A sourced ROS is in the path already.
    """
    paths = [*folders, Path(kfvo_ros.__file__).parents[1], os.environ.get('PYTHONPATH')]
    return os.environ | {'PYTHONPATH': os.pathsep.join(str(path) for path in paths if path)}


ENVIRONMENT = environment()


def run_module(module: str, *arguments: object, timeout: float = 30.0,
               **options: Any) -> subprocess.CompletedProcess[str]:
    """Run ``python -m module`` in the domain until it ends; `timeout` [s] is scaled."""
    return run_python('-m', module, *arguments, env=ENVIRONMENT, timeout_s=timeout, **options)


@contextmanager
def running_module(module: str, *arguments: object, env: dict[str, str] | None = None
                   ) -> Iterator[subprocess.Popen[str]]:
    """Yield ``python -m module`` running in the domain; it does not outlive the ``with``."""
    with started('-m', module, *arguments, env=env or ENVIRONMENT) as process:
        try:
            yield process
        finally:
            process.terminate()  # killed, it would leave shared memory behind
            with suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=time_limit(10.0))


def wait_until(condition: Callable[[], Any], timeout_s: float = 20.0) -> None:
    """Wait until the condition holds; AssertionError after the `time_limit` of `timeout_s`."""
    limit_s = time_limit(timeout_s)
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, f'not true within {limit_s:.0f} s'
        time.sleep(0.02)


class Listener:
    """A node in this process that records the messages of some topics, inside ``with``.

    ``received`` holds (time of arrival by time.monotonic [s], topic, message), in order.
    """

    def __init__(self, topics: dict[str, Any], qos: Any = 1000) -> None:
        self.received: list[tuple[float, str, Any]] = []
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node('listener', context=self._context)
        for topic, message_class in topics.items():
            self.node.create_subscription(message_class, topic, self._recorder(topic), qos)
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
        """Return the messages received on a topic."""
        return [message for _, name, message in list(self.received) if name == topic]

    def arrivals(self, topic: str) -> list[float]:
        """Return the times of arrival on a topic [s]."""
        return [arrival for arrival, name, _ in list(self.received) if name == topic]

    def _recorder(self, topic: str) -> Callable[[Any], None]:
        return lambda message: self.received.append((time.monotonic(), topic, message))
