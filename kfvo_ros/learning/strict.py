# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Dataclasses from what a YAML file says, every key of them and no other."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
from dataclasses import field, fields, is_dataclass
from typing import Any, TypeVar

from kfvo_ros.errors import KfvoError

Made = TypeVar('Made')
Range = tuple[float | None, float | None]
KINDS = {int: 'a whole number', float: 'a number', bool: 'true or false', str: 'a word'}


def key(least: float | None = None, most: float | None = None, choices: tuple[str, ...] = (),
        within: Mapping[str, Range] = types.MappingProxyType({})) -> Any:
    """Declare a field without a default: its range, or what it may be.

    `within` are ranges of the fields of a field that is a dataclass, and declares none itself.
    """
    return field(metadata={'least': least, 'most': most, 'choices': choices, 'within': within})


def from_mapping(kind: type[Made], mapping: Any, file: str, place: str = '',
                 within: Mapping[str, Range] = types.MappingProxyType({})) -> Made:
    """Build the dataclass; raises KfvoError naming the key, what was expected and what came.

    A field may be of a dataclass itself; one that may be None is null in the file.
    """
    names = [declared.name for declared in fields(kind)]  # type: ignore[arg-type]
    if not isinstance(mapping, dict):
        raise _unexpected(file, place, f'the keys {", ".join(names)}', mapping)
    for name in mapping:
        if name not in names:
            raise _unexpected(file, place, f'the keys {", ".join(names)}', name)
    hints = typing.get_type_hints(kind)
    values = {}
    for declared in fields(kind):  # type: ignore[arg-type]
        inner = f'{place}.{declared.name}'.lstrip('.')
        if declared.name not in mapping:
            raise KfvoError(f'{file}: expected the key {inner}, it is missing')
        least, most = within.get(declared.name, (None, None))
        values[declared.name] = _value(
            hints[declared.name], declared.metadata or {'least': least, 'most': most},
            mapping[declared.name], file, inner)
    return kind(**values)


def _value(hint: Any, meta: Any, value: Any, file: str, place: str) -> Any:
    """Return the value as its field wants it."""
    choices = typing.get_args(hint)
    if types.NoneType in choices:
        if value is None:
            return None
        hint = next(choice for choice in choices if choice is not types.NoneType)
    if is_dataclass(hint):
        return from_mapping(typing.cast('type[Any]', hint), value, file, place, meta['within'])
    if hint == tuple[str, ...]:
        if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
            raise _unexpected(file, place, 'a list of words', value)
        return tuple(value)
    if hint is float and not isinstance(value, bool):
        value = _number(value)
    if type(value) is not hint or not _within(value, meta):
        raise _unexpected(file, place, _wanted(hint, meta), value)
    return value


def _number(value: Any) -> Any:
    """Return a float where one is meant: YAML 1.1 takes 1 for an integer, 3e-4 for a word."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return value


def _within(value: Any, meta: Any) -> bool:
    if meta.get('choices'):
        return value in meta['choices']
    least, most = meta.get('least'), meta.get('most')
    return (least is None or value >= least) and (most is None or value <= most)


def _wanted(hint: Any, meta: Any) -> str:
    """Return what a field may be, in words."""
    if meta.get('choices'):
        return f'one of {", ".join(meta["choices"])}'
    ends = [f'{word} {meta[end]:g}' for word, end in (('at least', 'least'), ('at most', 'most'))
            if meta.get(end) is not None]
    return f'{KINDS[hint]} {" and ".join(ends)}'.rstrip()


def _unexpected(file: str, place: str, wanted: str, came: Any) -> KfvoError:
    return KfvoError(f'{file}: {f"{place}: " if place else ""}expected {wanted}; came {came!r}')
