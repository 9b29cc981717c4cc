# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A command's use of ROS, from its first call to its last."""

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

AnyNode = TypeVar('AnyNode', bound=Node)


def remove_ros_arguments(arguments: list[str]) -> list[str]:
    """Return the arguments that are not between ``--ros-args`` and ``--``; raises KfvoError."""
    with _ros_errors():
        return remove_ros_args(arguments)


@contextmanager
def spinning_node(make: Callable[[], AnyNode], arguments: list[str]) -> Iterator[AnyNode]:
    """Give a node, named and remapped by the ROS arguments among `arguments`, served by a thread.

    Signals are left to Python, so that the node lives, and may publish, until the ``with`` ends.
    """
    with _ros_errors():
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    try:
        with _ros_errors():
            node = make()
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
    """Serve callbacks; the error of one does not end the others."""
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
    """Turn what rclpy raises about arguments into a KfvoError."""
    try:
        yield
    except RuntimeError as error:  # the base of rclpy's own errors
        raise KfvoError(f'these ROS arguments do not work: {reason_of(error)}') from error
