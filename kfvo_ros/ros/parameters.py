# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters from dataclasses of options: declared, described, checked in readable lines."""

from __future__ import annotations

import difflib
from dataclasses import Field, fields
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.config import type_of

ROS_OWN = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
"""Beginnings of the names that rclpy declares itself."""
NAMES = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'text'}
MOST = {int: 2 ** 63 - 1, float: 1e308}


def read_parameters(node: Node, *kinds: type[Any]) -> list[Any]:
    """Declare the fields of options dataclasses as parameters of `node` and return the options.

    The node must have been made with ``automatically_declare_parameters_from_overrides``; what
    it was given and nobody declares is warned of. Raises KfvoError for a value that cannot be.
    """
    options = [kind(**{declared.name: _read(node, kind, declared) for declared in fields(kind)})
               for kind in kinds]
    known = [declared.name for kind in kinds for declared in fields(kind)]
    for name in node.get_parameters_by_prefix(''):
        if name not in known and not name.startswith(ROS_OWN):
            meant = difflib.get_close_matches(name, known, 1)
            node.get_logger().warning(
                f'unknown parameter {name}: '
                + (f'is {meant[0]} meant?' if meant else f'expected one of {", ".join(known)}'))
    return options


def _read(node: Node, kind: type[Any], declared: Field[Any]) -> Any:
    """Return the value of one parameter, declared with its description and range."""
    expected = type_of(kind, declared.name)
    # A parameter cannot be None: an empty text stands for it.
    default = '' if declared.default is None else declared.default
    value = default
    if node.has_parameter(declared.name):
        value = _checked(declared, expected, node.get_parameter(declared.name).value)
        node.undeclare_parameter(declared.name)
    node.declare_parameter(declared.name, value, _descriptor(declared, expected),
                           ignore_override=True)
    return None if declared.default is None and value == '' else value


def _checked(declared: Field[Any], expected: type, value: Any) -> Any:
    """Return the value in its type; raises KfvoError naming what was expected."""
    meta, text = declared.metadata, repr(value)
    if expected is float and type(value) is int:
        value = float(value)
    wish = ''
    if type(value) is not expected:
        wish = NAMES[expected]
    elif meta['choices'] and value not in meta['choices'] and not (
            value == '' and declared.default is None):
        wish = f'one of {", ".join(meta["choices"])}'
    elif meta['least'] is not None and not value >= meta['least']:
        wish = f'at least {meta["least"]}'
    elif meta['most'] is not None and not value <= meta['most']:
        wish = f'at most {meta["most"]}'
    if wish:
        raise KfvoError(f'parameter {declared.name}: expected {wish}, came {text}')
    return value


def _descriptor(declared: Field[Any], expected: type) -> ParameterDescriptor:
    meta = declared.metadata
    descriptor = ParameterDescriptor(description=meta['description'], read_only=True)
    if meta['choices']:
        descriptor.additional_constraints = f'one of {", ".join(meta["choices"])}'
    least, most = meta['least'], meta['most']
    if least is not None or most is not None:
        least = -MOST[expected] if least is None else least
        most = MOST[expected] if most is None else most
        if expected is int:
            descriptor.integer_range = [IntegerRange(from_value=int(least), to_value=int(most),
                                                     step=1)]
        else:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(least), to_value=float(most), step=0.0)]
    return descriptor
