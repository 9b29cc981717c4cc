# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start and shutdown of ROS around a command's node."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.ros.parameters import warn_of_ignored_files

AnyNode = TypeVar('AnyNode', bound=Node)


def remove_ros_arguments(arguments: list[str]) -> list[str]:
    """Return the arguments that are not between ``--ros-args`` and ``--``; raises KfvoError."""
    with _ros_errors():
        return remove_ros_args(arguments)


@contextmanager
def spinning_node(make_node: Callable[[], AnyNode], arguments: list[str]) -> Iterator[AnyNode]:
    """Yield a node whose callbacks run in a thread; destroy it and shut ROS down at the end.

    `arguments` may hold ROS arguments, which name, remap and configure the node. Signals are left
    to Python: the node can publish until the ``with`` ends. Raises KfvoError for ROS arguments
    that rclpy refuses.
    """
    with _ros_errors():
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    try:
        with _ros_errors():
            node = make_node()
            warn_of_ignored_files(node, arguments)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        thread = threading.Thread(target=_spin, args=[executor, node.get_logger()],
                                  name='spin', daemon=True)
        thread.start()
        try:
            yield node
        finally:
            executor.shutdown()
            thread.join()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def _spin(executor: SingleThreadedExecutor, logger: RcutilsLogger) -> None:
    """Run callbacks until shutdown; log an error of one and go on."""
    while True:
        try:
            executor.spin()
            return
        except (ExternalShutdownException, InvalidHandle):
            return
        except Exception:
            logger.error(f'unexpected error in a callback:\n{traceback.format_exc()}')


@contextmanager
def _ros_errors() -> Iterator[None]:
    """Turn rclpy's errors about arguments into a KfvoError."""
    try:
        yield
    except RuntimeError as error:  # the base of rclpy's own errors
        raise KfvoError(f'invalid ROS arguments: {reason_of(error)}') from error
