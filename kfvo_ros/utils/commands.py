# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frame of all commands: parser, exit status, errors in one line, and lists of values."""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import io
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError, printable, reason_of
from kfvo_ros.utils.config import MOST
from kfvo_ros.utils.signals import Interrupted, exit_status, signals_handled

DISTRIBUTIONS = {'cv2': 'opencv-python-headless', 'yaml': 'PyYAML', 'PIL': 'pillow'}
"""Distributions by module where the names differ."""
ROS_MODULES = frozenset(('rclpy', 'rcl_interfaces', 'rosgraph_msgs', 'sensor_msgs', 'nav_msgs',
                         'geometry_msgs', 'diagnostic_msgs', 'std_msgs', 'std_srvs',
                         'builtin_interfaces'))
"""Modules of a ROS 2 installation; the extra ``ros`` installs them as wheels."""
MAX_SEEDS = 10_000
"""Sequences in a range."""
NUMBER = re.compile('[0-9]{1,10}')
RANGE = re.compile(r'(synthetic):([0-9]{1,10})-([0-9]{1,10})((?::[a-z]+)?)')


def make_parser(command: str, description: str, examples: str = '') -> argparse.ArgumentParser:
    """Return a parser with ``--version``; description and examples keep their line breaks."""
    parser = _Parser(prog=command, description=description, epilog=examples,
                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--version', action='version', version=f'kfvo_ros {__version__}')
    return parser


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one printable line."""

    def error(self, message: str) -> NoReturn:
        """Print the usage and the message; exit with status 2."""
        super().error(printable(message))


class _LineFormatter(logging.Formatter):
    """Formats records as printable lines: they name what is in files and on topics."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        """Return the line of a record, without its traceback."""
        return printable(super().formatMessage(record))


def _configure_terminal(command: str) -> None:
    """Log warnings as lines of `command`; escape characters that a terminal cannot show."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='backslashreplace')
    handler = logging.StreamHandler()
    handler.setFormatter(_LineFormatter(f'{command}: %(levelname)s: %(message)s'))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)


def run_command(command: str, body: Callable[[list[str]], None], argv: list[str] | None,
                until_stopped: bool = False) -> int:
    """Call `body` with the arguments (None: those of the process); return the exit status.

    Errors that a user can cause end the command with one line on stderr and status 1; any other
    exception is a bug and keeps its traceback. A signal interrupts the command where its loops
    ask for it: status 128 plus the number of the signal, or 0 for one that runs `until_stopped`.
    """
    _configure_terminal(command)
    status = 1
    try:
        with signals_handled(until_stopped, until_exit=argv is None), _output_written():
            body(sys.argv[1:] if argv is None else argv)
        return 0
    except Interrupted as interruption:
        if until_stopped:
            return 0
        problem, status = f'interrupted; {interruption}'.rstrip('; '), exit_status()
    except ImportError as error:
        problem = str(missing_dependency(error))
    except KfvoError as error:
        problem = str(error)
    except MemoryError as error:  # numpy names the array
        problem = f'out of memory: {error}'.rstrip(': ')
    except OSError as error:
        problem = f'{error.filename or ""}: {reason_of(error)}'.lstrip(': ')
    with contextlib.suppress(OSError, ValueError):  # a closed or full stderr
        print(f'{command}: error: {printable(problem)}', file=sys.stderr)
    return status


@contextmanager
def _output_written() -> Iterator[None]:
    """Flush stdout at the end, so that a closed pipe or a full disk is reported."""
    try:
        yield
    finally:
        try:
            print(end='', flush=True)
        except OSError:
            # Python flushes again at exit and would print a traceback.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise


def missing_dependency(error: ImportError) -> KfvoError:
    """Return the error for a required module that is missing or cannot be imported.

    Raises the ImportError itself if kfvo_ros does not require the module: then it is a bug.
    """
    module = (error.name or '').partition('.')[0]
    problem = 'is missing' if isinstance(error, ModuleNotFoundError) else \
        f'cannot be imported ({reason_of(error)})'
    if module in ROS_MODULES:
        return KfvoError(f"{module} {problem}: source /opt/ros/jazzy/setup.bash, or pip install "
                         "'kfvo_ros[ros]' where there is none")
    distribution = DISTRIBUTIONS.get(module, module.replace('_', '-'))
    known = _requirements()
    if module == 'kfvo_ros' or (known and distribution.lower() not in known):
        raise error
    return KfvoError(f'{module} {problem}: pip install {distribution}')


def _requirements() -> set[str]:
    """Return the distributions that kfvo_ros requires, in lower case; empty if not installed."""
    try:
        lines = importlib.metadata.requires('kfvo_ros') or []
    except importlib.metadata.PackageNotFoundError:
        lines = []
    return {re.split(r'[^\w.-]', line, maxsplit=1)[0].replace('_', '-').lower() for line in lines}


def parse_names(text: str, what: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return the names of ``a,b,...``; raises KfvoError for one that is not `known`."""
    known, names = tuple(known), tuple(dict.fromkeys(text.split(',')))
    for name in names:
        if name not in known:
            raise KfvoError(f'{what}: expected names out of {", ".join(known)}, came {name!r}')
    return names


def parse_numbers(text: str, what: str, least: int = 0) -> tuple[int, ...]:
    """Return the whole numbers of ``1,2,...``; raises KfvoError for one out of range."""
    parts = text.split(',')
    if not all(NUMBER.fullmatch(part) and least <= int(part) <= MOST[int] for part in parts):
        raise KfvoError(f'{what}: expected whole numbers from {least} to {MOST[int]} with commas '
                        f'in between, came {text!r}')
    return tuple(dict.fromkeys(map(int, parts)))


def expand_ranges(texts: Iterable[str]) -> tuple[str, ...]:
    """Return the sequences with each ``synthetic:A-B[:STYLE]`` expanded to one per seed.

    Raises KfvoError for a range that is empty or too long.
    """
    return tuple(text for each in texts for text in _expand_range(each))


def _expand_range(text: str) -> list[str]:
    match = RANGE.fullmatch(text)
    if match is None:
        return [text]
    first, last = int(match[2]), int(match[3])
    if not 0 <= last - first < MAX_SEEDS:
        raise KfvoError(f'expected synthetic:A-B[:STYLE] with up to {MAX_SEEDS} seeds from A to '
                        f'B, came {text!r}')
    return [f'{match[1]}:{seed}{match[4]}' for seed in range(first, last + 1)]
