# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters of the fields of options dataclasses: declared with descriptors, and checked."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.config import Option, options_of

RCLPY_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
"""Prefixes of the parameters that rclpy declares itself."""
MOST = {int: 2 ** 63 - 1, float: 1e308}


def read_parameters(node: Node, *kinds: type[Any]) -> list[Any]:
    """Declare the fields of options dataclasses as parameters of `node` and return the options.

    The node must have been made with ``automatically_declare_parameters_from_overrides``; a
    parameter that it was given and no dataclass declares is a warning. Raises KfvoError for a
    value of the wrong type or out of range.
    """
    options = [kind(**{declared.name: _read(node, declared) for declared in options_of(kind)})
               for kind in kinds]
    _warn_of_unknown(node, [declared.name for kind in kinds for declared in options_of(kind)])
    return options


def _warn_of_unknown(node: Node, known: Iterable[str]) -> None:
    """Log a warning for each parameter that is neither known nor rclpy's own."""
    for name in node.get_parameters_by_prefix(''):
        if name not in known and not name.startswith(RCLPY_PARAMETERS):
            similar = difflib.get_close_matches(name, known, 1)
            node.get_logger().warning(
                f'unknown parameter {name}: '
                + (f'is {similar[0]} meant?' if similar else
                   f'expected one of {", ".join(known)}'))


def _read(node: Node, declared: Option) -> Any:
    """Return the value of one parameter; declare it with its description and range."""
    # A parameter cannot be None: an empty text stands for it.
    value = '' if declared.default is None else declared.default
    if node.has_parameter(declared.name):
        value = node.get_parameter(declared.name).value
        if not (declared.may_be_none and value == ''):
            try:
                value = declared.check(value)
            except ValueError as error:
                raise KfvoError(f'parameter {declared.name}: {error}') from error
        node.undeclare_parameter(declared.name)
    node.declare_parameter(declared.name, value, _descriptor(declared), ignore_override=True)
    return None if declared.may_be_none and value == '' else value


def _descriptor(declared: Option) -> ParameterDescriptor:
    """Return the descriptor of a parameter: description, choices, range."""
    descriptor = ParameterDescriptor(description=declared.description, read_only=True)
    if declared.choices:
        descriptor.additional_constraints = declared.expected
    least, most = declared.least, declared.most
    if least is not None or most is not None:
        least = -MOST[declared.kind] if least is None else least
        most = MOST[declared.kind] if most is None else most
        if declared.kind is int:
            descriptor.integer_range = [IntegerRange(from_value=int(least), to_value=int(most),
                                                     step=1)]
        else:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(least), to_value=float(most), step=0.0)]
    return descriptor
