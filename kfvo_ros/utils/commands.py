# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frame of all commands: parser, exit status, errors in one line, and lists of values."""

from __future__ import annotations

import argparse
import importlib.metadata
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.utils.signals import raise_on_signals

DISTRIBUTIONS = {'cv2': 'opencv-python-headless', 'yaml': 'PyYAML', 'PIL': 'pillow'}
"""Distributions by module where the names differ."""
ROS_MODULES = frozenset(('rclpy', 'rcl_interfaces', 'rosgraph_msgs', 'sensor_msgs', 'nav_msgs',
                         'geometry_msgs', 'diagnostic_msgs', 'std_msgs', 'std_srvs',
                         'builtin_interfaces'))
"""Modules of a ROS 2 installation; the extra ``ros`` installs them as wheels."""
MAX_SEEDS = 10_000
"""Sequences in a range."""
RANGE = re.compile(r'(synthetic):([0-9]{1,10})-([0-9]{1,10})((?::[a-z]+)?)')


def make_parser(command: str, description: str, examples: str = '') -> argparse.ArgumentParser:
    """Return a parser with ``--version``; description and examples keep their line breaks."""
    parser = argparse.ArgumentParser(prog=command, description=description, epilog=examples,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--version', action='version', version=f'kfvo_ros {__version__}')
    return parser


def run_command(command: str, body: Callable[[list[str]], None], argv: list[str] | None,
                until_stopped: bool = False) -> int:
    """Call `body` with the arguments (None: those of the process); return the exit status.

    Errors that a user can cause end the command with one line on stderr and status 1; any other
    exception is a bug and keeps its traceback. SIGINT and SIGTERM interrupt the command: status
    1, or 0 for one that runs `until_stopped`.
    """
    logging.basicConfig(format=f'{command}: %(levelname)s: %(message)s', level=logging.WARNING)
    raise_on_signals(even_ignored=until_stopped)
    try:
        with _output_written():
            body(sys.argv[1:] if argv is None else argv)
        return 0
    except KeyboardInterrupt:
        if until_stopped:
            return 0
        problem = 'interrupted'
    except ImportError as error:
        problem = str(missing_dependency(error))
    except KfvoError as error:
        problem = str(error)
    except MemoryError as error:  # numpy names the array
        problem = f'out of memory: {error}'.rstrip(': ')
    except OSError as error:
        problem = f'{error.filename or ""}: {reason_of(error)}'.lstrip(': ')
    print(f'{command}: error: {problem}', file=sys.stderr)
    return 1


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
    """Return the whole numbers of ``1,2,...``; raises KfvoError for one below `least`."""
    parts = text.split(',')
    if not all(part.isascii() and part.isdigit() and int(part) >= least for part in parts):
        raise KfvoError(f'{what}: expected whole numbers from {least} with commas in between, '
                        f'came {text!r}')
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
