# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Child processes that end with their parent, even if that is killed.

The parent holds the writing end of a pipe, which the kernel closes when the parent ends. A thread
of the child waits for that and ends the child, which otherwise would go on alone.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any


def start_child(module: str, arguments: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
    """Start a command, the `main` of a module, with these arguments as a child process.

    `options` are those of Popen. Raises OSError.
    """
    pipe = _pipe_of_this_process()
    return subprocess.Popen([sys.executable, '-m', __name__, str(pipe), module, *arguments],
                            pass_fds=(pipe,), **options)


def end_with_parent(wait: Callable[[], Any]) -> None:
    """Start a thread that ends this process at once when `wait` returns, as at a parent's end."""
    def wait_and_end() -> None:
        wait()
        os._exit(1)

    threading.Thread(target=wait_and_end, name='parent', daemon=True).start()


@cache
def _pipe_of_this_process() -> int:
    """Return the reading end of a pipe that stays open as long as this process."""
    reading, _ = os.pipe()  # neither end is a file object, which would close it
    return reading


def main() -> int:
    """Run the command of a child process."""
    pipe, module, *arguments = sys.argv[1:]
    end_with_parent(lambda: os.read(int(pipe), 1))
    return int(importlib.import_module(module).main(arguments))


if __name__ == '__main__':
    sys.exit(main())
