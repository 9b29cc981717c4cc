# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One schema for every option: a field of a frozen dataclass, declared and checked once.

`option` declares a field with its description, range and choices; `options_of` reads a dataclass
back as a list of `Option`. From that list follow command lines (`add_arguments`,
`from_arguments`, `to_arguments`), YAML files (`from_mapping`, `to_mapping`), ROS parameters
(kfvo_ros.ros.parameters) and launch arguments.
"""

from __future__ import annotations

import argparse
import functools
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from typing import Any, TypeVar

from kfvo_ros.errors import KfvoError, quoted

Options = TypeVar('Options')
Range = tuple[float | None, float | None]
NO_RANGES: Mapping[str, Range] = types.MappingProxyType({})
KINDS = {int: 'a whole number', float: 'a number', bool: 'true or false', str: 'text'}
MOST = {int: 2 ** 31 - 1, float: 1e9}
"""Largest number of an option that declares no smaller one."""
TRUE, FALSE = ('true', 'yes', 'on', '1'), ('false', 'no', 'off', '0')


def option(default: Any = MISSING, description: str = '', choices: tuple[str, ...] = (),
           least: float | None = None, most: float | None = None, bare: Any = None,
           flag: str = '', key: str = '', within: Mapping[str, Range] = NO_RANGES) -> Any:
    """Declare one field of an options dataclass.

    `bare` is the value of a command line option that is given without a value; `flag` and `key`
    are the names on command lines and in YAML files where they differ from the field's; `within`
    are ranges for the fields of a nested dataclass that declares none itself.
    """
    return field(default=default, metadata={
        'description': description, 'choices': choices, 'least': least, 'most': most,
        'bare': bare, 'flag': flag, 'key': key, 'within': within})


required = functools.partial(option, MISSING, '')
"""Declare a field without default or description: a key that a YAML file must have."""


@dataclass(frozen=True)
class Option:
    """One field of an options dataclass: its declaration and the type of its values.

    ``kind`` is the type without None and, of a tuple, that of its elements. Every number has a
    largest value.
    """

    name: str
    kind: type[Any]
    default: Any
    may_be_none: bool
    is_list: bool
    description: str = ''
    choices: tuple[str, ...] = ()
    least: float | None = None
    most: float | None = None
    bare: Any = None
    flag: str = ''
    key: str = ''
    within: Mapping[str, Range] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.most is None and not self.choices:
            object.__setattr__(self, 'most', MOST.get(self.kind))

    @property
    def expected(self) -> str:
        """Description of the allowed values."""
        if self.is_list:
            return 'a list of words'
        if self.choices:
            return f'one of {", ".join(self.choices)}'
        ends = [f'at {word} {end:.12g}' for word, end in (('least', self.least),
                                                          ('most', self.most)) if end is not None]
        return f'{KINDS[self.kind]}{" of " if ends else ""}{" and ".join(ends)}'

    def check(self, value: Any) -> Any:
        """Return a value in the type of the field; raises ValueError unless it is allowed."""
        if value is None and self.may_be_none:
            return None
        if self.is_list:
            if not isinstance(value, (list, tuple)) or not all(
                    isinstance(each, self.kind) for each in value):
                raise self._error(value)
            return tuple(value)
        checked = float(value) if self.kind is float and type(value) is int else value
        if type(checked) is not self.kind or not self._allows(checked):
            raise self._error(value)
        return checked

    def parse(self, text: str) -> Any:
        """Return the value of a text, of a list an element; raises as `check` does."""
        value: Any = text
        if self.kind is bool:
            value = {**dict.fromkeys(TRUE, True), **dict.fromkeys(FALSE, False)}.get(text.lower())
        elif self.kind is not str:
            try:
                value = self.kind(text)
            except (ValueError, OverflowError):
                raise self._error(text) from None
        if value is None or not self._allows(value):
            raise self._error(text)
        return value

    def _error(self, value: Any) -> ValueError:
        """Return the error that names the allowed values and the value."""
        return ValueError(f'expected {self.expected}, came {quoted(value)}')

    def _allows(self, value: Any) -> bool:
        """Whether a value of the right type is one of the choices or within the range."""
        if self.choices:
            return value in self.choices
        return ((self.least is None or value >= self.least)
                and (self.most is None or value <= self.most))


def options_of(kind: type[Any]) -> tuple[Option, ...]:
    """Return the options that an options dataclass declares, in order."""
    hints = typing.get_type_hints(kind)
    found = []
    for declared in fields(kind):
        parts = typing.get_args(hints[declared.name]) or (hints[declared.name],)
        kinds = [part for part in parts if part not in (types.NoneType, Ellipsis)]
        is_list = typing.get_origin(hints[declared.name]) is tuple
        found.append(Option(declared.name, kinds[0], declared.default,
                            types.NoneType in parts, is_list, **declared.metadata))
    return tuple(found)


# Command lines


def add_arguments(parser: argparse.ArgumentParser, options: type[Any],
                  without: tuple[str, ...] = ()) -> None:
    """Add one ``--name`` for each field of an options dataclass except those of `without`."""
    group = parser.add_argument_group((options.__doc__ or '').splitlines()[0].rstrip('.'))
    for declared in options_of(options):
        if declared.name in without:
            continue
        keywords: dict[str, Any] = {'help': declared.description, 'default': declared.default}
        if declared.kind is bool:
            keywords['action'] = 'store_true'
        else:
            keywords |= {'type': functools.partial(_parse_argument, declared),
                         'metavar': f'{{{",".join(declared.choices)}}}' if declared.choices
                         else declared.name.upper()}
            if declared.default not in (None, MISSING, ()):
                keywords['help'] += ' (default: %(default)s)'
        if declared.is_list:
            keywords |= {'action': 'append', 'default': None}
        if declared.bare is not None:
            keywords |= {'nargs': '?', 'const': declared.bare}
        group.add_argument(_flag(declared), dest=declared.name, **keywords)


def from_arguments(options: type[Options], arguments: argparse.Namespace) -> Options:
    """Return the dataclass of parsed arguments; fields that are missing have their defaults."""
    values = {declared.name: getattr(arguments, declared.name, None)
              for declared in options_of(options)}
    return options(**{name: tuple(value) if isinstance(value, list) else value
                      for name, value in values.items() if value is not None})


def to_arguments(options: Any) -> list[str]:
    """Return the command line that yields these options; defaults are omitted."""
    arguments = []
    for declared in options_of(type(options)):
        value = getattr(options, declared.name)
        if value == declared.default:
            continue
        if value is True:
            arguments.append(_flag(declared))
        else:
            # With '=', since a value may begin with a dash.
            arguments += [f'{_flag(declared)}={each}'
                          for each in (value if isinstance(value, tuple) else (value,))]
    return arguments


def _flag(declared: Option) -> str:
    return f'--{(declared.flag or declared.name).replace("_", "-")}'


def _parse_argument(declared: Option, text: str) -> Any:
    """Return the value of a text; raises the error that argparse reports."""
    try:
        return declared.parse(text)
    except ValueError as error:
        hint = '' if declared.bare is None else \
            '; without a value it must not stand before another argument'
        raise argparse.ArgumentTypeError(f'{error}{hint}') from error


# YAML files


def from_mapping(options: type[Options], mapping: Any, file: str, parent: str = '',
                 within: Mapping[str, Range] = NO_RANGES) -> Options:
    """Return the dataclass of a mapping that has every key and no other.

    Fields may be dataclasses themselves; null is None. `parent` is the key path of the mapping
    in `file`. Raises KfvoError with file and key path, what was expected and what came.
    """
    declared = {each.key or each.name: each for each in options_of(options)}
    if not isinstance(mapping, dict):
        raise _unexpected(file, parent, declared, mapping)
    for name in mapping:
        if name not in declared:
            raise _unexpected(file, parent, declared, name)
    values = {}
    for name, each in declared.items():
        key = f'{parent}.{name}'.lstrip('.')
        if name not in mapping:
            raise KfvoError(f'{file}: expected the key {key}, it is missing')
        values[each.name] = _value_of(each, mapping[name], file, key, within.get(each.name))
    return options(**values)


def to_mapping(options: Any) -> dict[str, Any]:
    """Return the mapping that `from_mapping` takes, nested dataclasses included."""
    mapping = {}
    for each in options_of(type(options)):
        value = getattr(options, each.name)
        mapping[each.key or each.name] = to_mapping(value) if is_dataclass(value) else value
    return mapping


def _value_of(declared: Option, value: Any, file: str, key: str, range_: Range | None) -> Any:
    """Return a value of a YAML file in the type of its field."""
    if is_dataclass(declared.kind):
        if value is None and declared.may_be_none:
            return None
        return from_mapping(declared.kind, value, file, key, declared.within)
    if range_ is not None:
        declared = Option(declared.name, declared.kind, declared.default, declared.may_be_none,
                          declared.is_list, least=range_[0], most=range_[1])
    if declared.kind is float and isinstance(value, str):
        value = _number(value)
    try:
        return declared.check(value)
    except (ValueError, OverflowError):
        raise KfvoError(f'{file}: {key}: expected {declared.expected}; came '
                        f'{quoted(value)}') from None


def _number(text: str) -> Any:
    """Return the number of a text, or the text: YAML 1.1 reads 3e-4 as text."""
    try:
        return float(text)
    except ValueError:
        return text


def _unexpected(file: str, parent: str, declared: Mapping[str, Option], came: Any) -> KfvoError:
    return KfvoError(f'{file}: {f"{parent}: " if parent else ""}expected the keys '
                     f'{", ".join(declared)}; came {quoted(came)}')
