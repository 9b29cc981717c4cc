# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Dataclasses from what a YAML file says, every key of them and no other."""

from __future__ import annotations

import argparse
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, Field, field, fields, is_dataclass
from typing import Any, TypeVar

from kfvo_ros.errors import KfvoError

Section = TypeVar('Section')
Range = tuple[float | None, float | None]
KINDS = {int: 'a whole number', float: 'a number', bool: 'true or false', str: 'a word'}
Options = TypeVar('Options')


def required(least: float | None = None, most: float | None = None, choices: tuple[str, ...] = (),
             within: Mapping[str, Range] = types.MappingProxyType({})) -> Any:
    """Declare a field without a default: its range, or what it may be.

    `within` are ranges of the fields of a field that is a dataclass, and declares none itself.
    """
    return field(metadata={'least': least, 'most': most, 'choices': choices, 'within': within})


def from_mapping(kind: type[Section], mapping: Any, file: str, place: str = '',
                 within: Mapping[str, Range] = types.MappingProxyType({})) -> Section:
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


def option(default: Any, description: str, choices: tuple[str, ...] = (),
           least: float | None = None, most: float | None = None, bare: Any = None,
           flag: str = '') -> Any:
    """Declare one field: its default, what it does, what it may be, and what no value means.

    `flag` is its name on command lines, if another than the field's.
    """
    return field(default=default, metadata={'description': description, 'choices': choices,
                                            'least': least, 'most': most, 'bare': bare,
                                            'flag': flag})


def add_arguments(parser: argparse.ArgumentParser, options: type[Any],
                  without: tuple[str, ...] = ()) -> None:
    """Add one ``--name`` for each field of an options dataclass, `without` some of them."""
    group = parser.add_argument_group((options.__doc__ or '').splitlines()[0].rstrip('.'))
    for declared in fields(options):
        if declared.name in without:
            continue
        meta = declared.metadata
        about: dict[str, Any] = {'help': meta['description'], 'default': declared.default}
        if isinstance(declared.default, bool):
            about |= {'action': 'store_true'}
        else:
            about |= {'choices': meta['choices'] or None,
                      'metavar': None if meta['choices'] else declared.name.upper(),
                      'type': _parser_of(options, declared.name, meta)}
            if declared.default not in (None, MISSING, ()):
                about['help'] += ' (default: %(default)s)'
        if isinstance(declared.default, tuple):
            about |= {'action': 'append', 'default': None}
        if meta['bare'] is not None:
            about |= {'nargs': '?', 'const': meta['bare']}
        group.add_argument(_flag(declared), dest=declared.name, **about)


def from_arguments(options: type[Options], arguments: argparse.Namespace) -> Options:
    """Build the dataclass from parsed arguments; what was left out is the default."""
    values = {declared.name: getattr(arguments, declared.name, None)
              for declared in fields(options)}  # type: ignore[arg-type]
    return options(**{name: tuple(value) if isinstance(value, list) else value
                      for name, value in values.items() if value is not None})


def to_arguments(options: Any) -> list[str]:
    """Return the command line that gives these options; defaults stay unsaid."""
    arguments = []
    for declared in fields(options):
        value = getattr(options, declared.name)
        if value == declared.default:
            continue
        if value is True:
            arguments.append(_flag(declared))
        else:
            # With '=', for a value may begin with a dash.
            arguments += [f'{_flag(declared)}={each}'
                          for each in (value if isinstance(value, tuple) else (value,))]
    return arguments


def type_of(options: type[Any], name: str) -> type[Any]:
    """Return the type of a field, that of its elements if it is a tuple, without None."""
    hint = typing.get_type_hints(options)[name]
    return next(part for part in typing.get_args(hint) or (hint,) if part is not types.NoneType)


def _flag(declared: Field[Any]) -> str:
    return f'--{(declared.metadata["flag"] or declared.name).replace("_", "-")}'


def _parser_of(options: type[Any], name: str, meta: Any) -> Any:
    """Return a function from text to the field's type, within its range."""
    kind = type_of(options, name)

    def parse(text: str) -> Any:
        """Return the value of a text; raises what argparse reports."""
        try:
            value = kind(text)
        except ValueError as error:
            if meta['bare'] is None:
                raise
            raise argparse.ArgumentTypeError(
                f'invalid {kind.__name__} value: {text!r}; without a value it must not stand '
                'before another argument') from error
        if kind is not str and not (meta['least'] is None or value >= meta['least']):
            raise argparse.ArgumentTypeError(f'expected at least {meta["least"]}, came {text}')
        if kind is not str and not (meta['most'] is None or value <= meta['most']):
            raise argparse.ArgumentTypeError(f'expected at most {meta["most"]}, came {text}')
        return value

    parse.__name__ = kind.__name__
    return parse
