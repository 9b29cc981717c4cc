# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters of the fields of options dataclasses: declared with descriptors, and checked."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from kfvo_ros.errors import KfvoError, printable
from kfvo_ros.utils.config import Option, options_of
from kfvo_ros.utils.files import read_yaml

RCLPY_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
"""Prefixes of the parameters that rclpy declares itself."""
MOST = {int: 2 ** 63 - 1, float: 1e308}


def read_parameters(node: Node, *kinds: type[Any]) -> list[Any]:
    """Declare the fields of options dataclasses as parameters of `node` and return the options.

    A parameter that the node was given and no dataclass declares is a warning. Raises KfvoError
    for a value of the wrong type or out of range.
    """
    # rclpy can declare what the node was given itself, but not an empty list.
    given = {name: parameter.value for name, parameter in node._parameter_overrides.items()}
    _warn_of_unknown(node, given, [each.name for kind in kinds for each in options_of(kind)])
    return [kind(**{each.name: _read(node, each, given) for each in options_of(kind)})
            for kind in kinds]


def warn_of_ignored_files(node: Node, arguments: list[str]) -> None:
    """Log a warning for each parameter file in ROS arguments that has nothing for this node."""
    name = node.get_fully_qualified_name()
    for flag, file in pairwise(arguments):
        if flag != '--params-file':
            continue
        try:
            sections = dict(_sections(read_yaml(Path(file))))
        except KfvoError:  # rcl reads more than this does, or has refused the file
            continue
        if sections and not any(_matches(key, name) for key in sections):
            keys = '; '.join(f'{", ".join(parameters) or "nothing"} of {key}'
                             for key, parameters in sections.items())
            node.get_logger().warning(
                f'{file} has no parameters of {name}, so it is ignored: {printable(keys)}. Write '
                f'them below {name} or /**')


def _sections(document: Any, parent: str = '') -> Iterator[tuple[str, list[str]]]:
    """Yield the names of nodes in a parameter file, with the names of their parameters."""
    for key, value in document.items() if isinstance(document, dict) else ():
        if key == 'ros__parameters':
            yield parent or '/', list(map(str, value)) if isinstance(value, dict) else []
        else:
            yield from _sections(value, f'{parent}/{str(key).strip("/")}')


def _matches(key: str, name: str) -> bool:
    """Return whether a key of a parameter file, which may have * and **, names a node."""
    words = (re.escape(word).replace(r'\*\*', '.*').replace(r'\*', '[^/]+')
             for word in key.split('/'))
    return re.fullmatch('/'.join(words).replace('/.*', '(/.*)?'), name) is not None


def _warn_of_unknown(node: Node, given: Iterable[str], known: Iterable[str]) -> None:
    """Log a warning for each parameter that is neither known nor rclpy's own."""
    for name in given:
        if name not in known and not name.startswith(RCLPY_PARAMETERS):
            similar = difflib.get_close_matches(name, known, 1)
            node.get_logger().warning(
                f'unknown parameter {name}: '
                + (f'is {similar[0]} meant?' if similar else
                   f'expected one of {", ".join(known)}'))


def _read(node: Node, declared: Option, given: Mapping[str, Any]) -> Any:
    """Return the value of one parameter; declare it with its description and range."""
    # A parameter cannot be None: an empty text stands for it.
    value = '' if declared.default is None else declared.default
    if declared.name in given:
        value = given[declared.name]
        try:
            if value is None:
                raise ValueError(f'expected {declared.expected}, came an empty list')
            if not (declared.may_be_none and value == ''):
                value = declared.check(value)
        except ValueError as error:
            raise KfvoError(f'parameter {declared.name}: {error}') from error
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
