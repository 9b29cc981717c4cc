# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A command's use of ROS, from its first call to its last."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from kfvo_ros.errors import KfvoError


def without_ros_arguments(arguments: list[str]) -> list[str]:
    """Return the arguments that are not between ``--ros-args`` and ``--``; raises KfvoError."""
    with _told():
        return remove_ros_args(arguments)


@contextmanager
def publishing_node(name: str, arguments: list[str]) -> Iterator[Node]:
    """Give a node, named and remapped by the ROS arguments among `arguments`.

    Its events, such as a subscriber whose QoS does not fit, are told by a thread. Signals are
    left to Python, so that the node lives until the ``with`` ends.
    """
    with _told():
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node(name, start_parameter_services=False)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, name='spin', daemon=True)
    thread.start()
    try:
        yield node
    finally:
        executor.shutdown()
        thread.join()
        node.destroy_node()
        rclpy.try_shutdown()


@contextmanager
def _told() -> Iterator[None]:
    """Turn what rclpy raises about arguments into a KfvoError."""
    try:
        yield
    except RuntimeError as error:  # the base of rclpy's own errors
        reason = ' '.join(str(error).split())
        raise KfvoError(f'these ROS arguments do not work: {reason}') from error
