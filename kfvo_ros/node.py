# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``kfvo_node``, also ``python -m kfvo_ros.node``: visual odometry as a ROS 2 node."""

from __future__ import annotations

import sys

from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.signals import Interrupted, sleep

EXAMPLES = """examples:
  kfvo_node --ros-args -r image:=/camera/image_raw
  kfvo_node --ros-args --params-file config/euroc.yaml -p keyframes:=every
"""


def main(argv: list[str] | None = None) -> int:
    """Run the node until a signal ends it; return the exit status."""
    return run_command('kfvo_node', _run, argv, until_stopped=True)


def _run(argv: list[str]) -> None:
    from kfvo_ros.ros.node import KfvoNode
    from kfvo_ros.ros.runtime import remove_ros_arguments, spinning_node
    from kfvo_ros.utils.process import single_threaded
    _parse(remove_ros_arguments(argv))
    with single_threaded(), spinning_node(KfvoNode, argv) as node:
        try:
            while node.context.ok():
                sleep(0.5)
        except Interrupted:
            pass
        finally:
            node.close()


def _parse(argv: list[str]) -> None:
    from kfvo_ros.ros.options import describe, node_parameters
    make_parser('kfvo_node', 'Visual odometry of one camera. All options are ROS parameters:\n\n'
                + describe(node_parameters()), EXAMPLES).parse_args(argv)


if __name__ == '__main__':
    sys.exit(main())
