# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The messages of this ROS installation: their Python classes and their wire format."""

from __future__ import annotations

import importlib
import importlib.util
import re
from pathlib import Path
from typing import Any

RENAMED = {'tf/msg/tfMessage': 'tf2_msgs/msg/TFMessage'}
"""Types of ROS 1 that ROS 2 has under another name."""

_KIND = re.compile(r'([a-z]\w*)/msg/([A-Za-z]\w*)', re.ASCII)
_SEQUENCE = re.compile(r'sequence<(.+?)(?:, \d+)?>')
_ARRAY = re.compile(r'(.+)(\[\d+\])')
_BOUNDED_STRING = re.compile(r'(w?string)<\d+>')
_PRIMITIVES = {'boolean': 'bool', 'octet': 'byte', 'float': 'float32', 'double': 'float64'}


def find_message_class(kind: str) -> type[Any] | None:
    """Return the class of a type such as ``sensor_msgs/msg/Image``, or None without one."""
    found = _KIND.fullmatch(RENAMED.get(kind, kind))
    if found is None:
        return None
    package, name = found.groups()
    # Nothing is imported because a bag names it, unless it is a package of messages.
    spec = importlib.util.find_spec(package)
    folders = spec.submodule_search_locations if spec else None
    if not any(Path(folder, 'msg', '__init__.py').is_file() for folder in folders or ()):
        return None
    return getattr(importlib.import_module(f'{package}.msg'), name, None)


def layout_of(message_class: Any) -> str:
    """Return the wire format, in the words of `kfvo_ros.sequences.bag_reader.Bag.layout`."""
    return ' '.join(map(_describe, message_class.get_fields_and_field_types().values()))


def _describe(field: str) -> str:
    """Return ``uint8[]`` for ``sequence<uint8>``, ``(int32 uint32)`` for a nested Time."""
    if found := _SEQUENCE.fullmatch(field):
        return f'{_describe(found[1])}[]'
    if found := _ARRAY.fullmatch(field):
        return f'{_describe(found[1])}{found[2]}'
    if found := _BOUNDED_STRING.fullmatch(field):
        return found[1]
    if '/' in field:
        nested = find_message_class(field.replace('/', '/msg/'))
        return f'({layout_of(nested) if nested else field})'
    return _PRIMITIVES.get(field, field)
