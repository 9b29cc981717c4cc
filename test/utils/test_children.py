# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Child processes: they end with a parent that is killed, and only then."""

from __future__ import annotations

import time
from pathlib import Path

from command_lines import ENVIRONMENT, started

from kfvo_ros.utils.children import start_child
from kfvo_ros.utils.process import time_limit

COMMAND = """
import sys, time
def main(arguments):
    with open(arguments[0], 'a') as file:
        for _ in range(600):
            print(end='.', file=file, flush=True)
            time.sleep(0.05)
    return 0
"""
PARENT = """
import sys, time
from kfvo_ros.utils.children import start_child
print(start_child('endless', sys.argv[1:]).pid, flush=True)
time.sleep(60)
"""
TIMEOUT_S = 60.0


def wait_for(condition) -> None:
    """Wait until the condition holds."""
    end = time.monotonic() + time_limit(TIMEOUT_S)
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_child_ends_with_its_killed_parent(tmp_path: Path):
    (tmp_path / 'endless.py').write_text(COMMAND)
    output = tmp_path / 'output'
    environment = ENVIRONMENT | {'PYTHONPATH': f'{ENVIRONMENT["PYTHONPATH"]}:{tmp_path}'}
    with started('-c', PARENT, output, env=environment) as parent:
        child = int(parent.stdout.readline())
        wait_for(lambda: output.exists() and output.stat().st_size > 3)
        assert Path('/proc', str(child)).exists() and parent.poll() is None
        parent.kill()
        parent.wait()
        # Whoever adopts it may leave it as a zombie, which has no command line.
        command = Path('/proc', str(child), 'cmdline')
        wait_for(lambda: not command.exists() or not command.read_bytes())
    written = output.stat().st_size
    time.sleep(0.2)
    assert output.stat().st_size == written < 600


def test_arguments_exit_status_and_output_are_those_of_the_command(tmp_path: Path):
    with (tmp_path / 'log').open('wb') as log:
        children = [start_child('kfvo_ros.run', arguments, stdout=log, stderr=log, env=ENVIRONMENT)
                    for arguments in (['--version'], ['/no/such', '--output', str(tmp_path)])]
        assert [child.wait(time_limit(TIMEOUT_S)) for child in children] == [0, 1]
    log = (tmp_path / 'log').read_text()
    assert 'kfvo_ros 0.' in log and 'kfvo_run: error: /no/such does not exist' in log
