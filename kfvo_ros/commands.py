# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the commands share: how their arguments look, and how each of them ends."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.interruption import raise_on_signals
from kfvo_ros.requirements import missing_dependency


def make_parser(command: str, description: str, examples: str = '') -> argparse.ArgumentParser:
    """Return a parser with ``--version``; description and examples keep their lines."""
    parser = argparse.ArgumentParser(prog=command, description=description, epilog=examples,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--version', action='version', version=f'kfvo_ros {__version__}')
    return parser


def run_command(command: str, body: Callable[[list[str]], None], argv: list[str] | None,
                until_stopped: bool = False) -> int:
    """Call `body` with the arguments, None for this process's own; return the exit status.

    What a user can meet ends it in one line on stderr and status 1; whatever else is raised is
    a mistake of ours and keeps its traceback. SIGINT and SIGTERM interrupt it, which is the
    usual end, of status 0, of a command that runs `until_stopped`.
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
    except MemoryError as error:  # numpy tells for what, Python does not
        problem = f'out of memory: {error}'.rstrip(': ')
    except OSError as error:
        problem = f'{error.filename or ""}: {reason_of(error)}'.lstrip(': ')
    print(f'{command}: error: {problem}', file=sys.stderr)
    return 1


@contextmanager
def _output_written() -> Iterator[None]:
    """Write out what was printed while it can still be told that nobody can take it."""
    try:
        yield
    finally:
        try:
            print(end='', flush=True)
        except OSError:
            # Python would try again at its exit, and fail with a traceback.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise
