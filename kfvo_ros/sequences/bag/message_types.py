# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Message types as a recording defines them; one that is broken spoils no other."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from kfvo_ros.errors import KfvoError, reason_of

HEADER = 'std_msgs/msg/Header'
TYPE_NAME = re.compile(r'[A-Za-z]\w*/(\w+/)?[A-Za-z]\w*', re.ASCII)
IDL_SEPARATOR = '=' * 80 + '\n'
"""Line before each file of a concatenated IDL definition."""


class MessageTypes:
    """The types of connections, and the connections by topic that they can decode.

    Types without a definition, as recorded before ROS 2 Iron, are those of ROS 2 Jazzy.
    ``passed_over`` maps the other topics to the reason.
    """

    def __init__(self, connections: Iterable[Connection], is_ros1: bool,
                 warn: Callable[[str], None]) -> None:
        self.passed_over: dict[str, str] = {}
        self.connections: dict[str, list[Connection]] = {}
        self._is_ros1 = is_ros1
        self._stores: dict[str, Any] = {}
        self._ros2_stores: dict[str, Any] = {}
        self._checked: set[str] = set()
        connections = list(connections)
        are_defined = any(connection.msgdef.format != MessageDefinitionFormat.NONE
                          for connection in connections)
        for connection in connections:
            try:
                self._register(connection)
            except Exception as error:  # of rosbags' parsers
                reason = f'definition of {connection.msgtype}: {reason_of(error)}'
                self.passed_over[connection.topic] = reason
                if are_defined:
                    warn(f'{connection.topic} is passed over: {reason}')
                continue
            self.connections.setdefault(connection.topic, []).append(connection)
        for topic, same in list(self.connections.items()):
            if len(kinds := {connection.msgtype for connection in same}) > 1:
                self.passed_over[topic] = f'several types: {", ".join(sorted(kinds))}'
                del self.connections[topic]

    def decode(self, raw: bytes, kind: str) -> Any:
        """Return a message; raises the errors of rosbags for one that is damaged."""
        store = self._stores[kind]
        return store.deserialize_ros1(raw, kind) if self._is_ros1 else \
            store.deserialize_cdr(raw, kind)

    def check_fields(self, kind: str) -> None:
        """Raise KfvoError if the definition of a standard type lacks some of its fields."""
        if kind in self._checked:
            return
        missing = _missing_fields(_standard().fielddefs, self._stores[kind].fielddefs, kind)
        if missing:
            raise KfvoError(f'the recorded definition of {kind} has no {", ".join(missing)}; '
                            'expected the standard message')
        self._checked.add(kind)

    def ros2_store(self, kind: str) -> Any:
        """Return the type store of a type in ROS 2: as recorded, except for ROS 1's header.

        None for a type that the recording does not define.
        """
        store = self._stores.get(kind)
        if store is None or not self._is_ros1:
            return store
        if kind not in self._ros2_stores:
            converted = get_typestore(Stores.EMPTY)
            converted.register(store.fielddefs | {HEADER: _standard().fielddefs[HEADER]})
            self._ros2_stores[kind] = converted
        return self._ros2_stores[kind]

    def _register(self, connection: Connection) -> None:
        """Make the type store of a connection's type, once; check its digest."""
        kind = connection.msgtype
        if not TYPE_NAME.fullmatch(kind):
            raise KfvoError('expected a name such as sensor_msgs/msg/Image')
        if kind not in self._stores:
            store = get_typestore(Stores.EMPTY)
            if connection.msgdef.format == MessageDefinitionFormat.NONE:
                store = _standard()
                if kind not in store.fielddefs:
                    raise KfvoError('none is recorded')
            else:
                store.register(_parse(connection))
            if connection.digest:
                digest = store.generate_msgdef(kind)[1] if self._is_ros1 else \
                    store.hash_rihs01(kind)
                if digest != connection.digest:
                    raise KfvoError('it does not have the digest recorded with it')
            self._stores[kind] = store


@cache
def _standard() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)


def _missing_fields(standard: Any, recorded: Any, kind: str, prefix: str = '') -> list[str]:
    """Return the standard fields that a recorded type lacks; letter case is ignored."""
    if kind not in standard or kind not in recorded:
        return []
    names = {name.lower() for name, _ in recorded[kind][1]}
    missing = []
    for name, (node, content) in standard[kind][1]:
        if name.lower() not in names and name != 'structure_needs_at_least_one_member':
            missing.append(f'{prefix}{name}')
        elif node == Nodetype.NAME:
            missing += _missing_fields(standard, recorded, content, f'{prefix}{name}.')
    return missing


def _parse(connection: Connection) -> dict[str, Any]:
    """Return the definitions recorded with a connection."""
    definition = connection.msgdef
    if definition.format == MessageDefinitionFormat.MSG:
        return dict(get_types_from_msg(definition.data, connection.msgtype))
    if not definition.data.startswith(f'{IDL_SEPARATOR}IDL: '):
        return dict(get_types_from_idl(definition.data))
    types: dict[str, Any] = {}
    for part in definition.data.split(IDL_SEPARATOR)[1:]:
        types |= get_types_from_idl(part.partition('\n')[2])
    return types
