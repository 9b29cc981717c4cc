# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How every command ends: well, in one line for what users meet, or in a traceback for us."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import pytest
from command_lines import ENVIRONMENT, one_readable_line, run_interrupted, run_python

import kfvo_ros

COMMANDS = ('run', 'convert', 'play', 'node', 'demo', 'train', 'ablation', 'benchmark')
LIGHT_COMMANDS = ('run', 'convert', 'play', 'demo', 'train', 'benchmark')
SCRIPT = """
import logging, os, signal, sys, time
import numpy as np
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.errors import KfvoError

def body(argv):
    {body}

{before}
sys.exit(run_command('kfvo_test', body, sys.argv[1:], until_stopped={until_stopped}))
"""


def script(body: str, until_stopped: bool = False, before: str = '') -> list[str]:
    """Return Python's arguments for a command that does this, of one line."""
    return ['-c', SCRIPT.format(body=body, until_stopped=until_stopped, before=before)]


def test_a_command_that_ends_well():
    body = 'print(*argv); logging.getLogger("kfvo_ros.part").warning("it is late")'
    done = run_python(*script(body), 'one', 'two')
    assert (done.returncode, done.stdout) == (0, 'one two\n')
    assert done.stderr == 'kfvo_test: WARNING: it is late\n'


@pytest.mark.parametrize(('body', 'line'), [
    ('raise KfvoError("expected this, came that")', 'expected this, came that'),
    ('open("/no/such/file")', '/no/such/file: No such file or directory'),
    ('os.write(os.open("/dev/full", os.O_WRONLY), b"1")', 'No space left on device'),
    ('os.read(99, 1)', 'Bad file descriptor'),
    ('raise OSError("only words")', 'only words'),
    ('bytearray(1 << 62)', 'out of memory'),
    ('np.zeros(1 << 59, dtype=np.uint8)', 'out of memory: Unable to allocate 512. PiB'),
    ('sys.modules["tqdm"] = None; import tqdm', 'tqdm is missing: pip install tqdm'),
    ('sys.modules["rclpy"] = None; import rclpy', 'rclpy is missing: source /opt/ros/jazzy'),
    ('raise ImportError("libGL.so.1:\\n no such file", name="cv2")',
     'cv2 cannot be imported (libGL.so.1: no such file): pip install opencv-python-headless'),
])
def test_what_users_meet_is_told_in_one_line(body, line):
    done = run_python(*script(body))
    assert done.returncode == 1
    assert one_readable_line(done).startswith(f'kfvo_test: error: {line}')


@pytest.mark.parametrize(('body', 'last_line'), [
    ('1 / 0', 'ZeroDivisionError: division by zero'),
    ('import kfvo_ros.none', "ModuleNotFoundError: No module named 'kfvo_ros.none'")])
def test_a_mistake_of_ours_keeps_its_traceback(body, last_line):
    done = run_python(*script(body))
    assert done.returncode == 1 and 'Traceback' in done.stderr
    assert done.stderr.splitlines()[-1] == last_line


@pytest.mark.parametrize('body', ['print("result")', 'print("result" * 10000)',
                                  'make_parser("kfvo_test", "Test.").parse_args(["--help"])'])
def test_output_that_nobody_can_take(body):
    environment = ENVIRONMENT | {'PYTHONUNBUFFERED': ''}  # where argparse looks away
    with open('/dev/full', 'w') as full:
        done = run_python(*script(body), stdout=full, env=environment)
    assert one_readable_line(done) == 'kfvo_test: error: No space left on device'
    reading, writing = os.pipe()
    os.close(reading)
    done = run_python(*script(body), stdout=writing, env=environment)
    os.close(writing)
    assert one_readable_line(done) == 'kfvo_test: error: Broken pipe'
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize('until_stopped', [False, True])
@pytest.mark.parametrize('sent', [signal.SIGINT, signal.SIGTERM])
def test_signals(sent, until_stopped, tmp_path: Path):
    started = tmp_path / 'started'
    # A signal just before a sleep is handled after it, so the sleeps are short; one that arrives
    # while a file object is freed is lost, so there is none.
    body = (f'os.close(os.open({str(started)!r}, os.O_CREAT)); '
            '[time.sleep(0.05) for _ in range(1200)]')
    status, output, problems = run_interrupted(sent, started.exists,
                                               *script(body, until_stopped))
    assert (status, output) == ((0, '') if until_stopped else (1, ''))
    assert problems == ('' if until_stopped else 'kfvo_test: error: interrupted\n')


@pytest.mark.parametrize('until_stopped', [False, True])
def test_an_ignored_interruption(until_stopped):
    """Shells let what a script starts in the background ignore SIGINT."""
    done = run_python(*script('signal.raise_signal(signal.SIGINT); print("went on")',
                              until_stopped, 'signal.signal(signal.SIGINT, signal.SIG_IGN)'))
    assert done.returncode == 0, done.stderr
    assert done.stdout == ('' if until_stopped else 'went on\n')


@pytest.mark.parametrize('command', COMMANDS)
def test_version_and_wrong_arguments(command):
    if command == 'node':
        pytest.importorskip('rclpy', reason='rclpy is not installed')
    done = run_python('-m', f'kfvo_ros.{command}', '--version')
    assert (done.returncode, done.stdout) == (0, f'kfvo_ros {kfvo_ros.__version__}\n')
    done = run_python('-m', f'kfvo_ros.{command}', '--no-such-option')
    assert done.returncode == 2
    assert re.match(rf'kfvo_{command}: error: ', one_readable_line(done))


@pytest.mark.parametrize('command', LIGHT_COMMANDS)
def test_help_comes_without_what_takes_long_to_import(command):
    done = run_python('-X', 'importtime', '-m', f'kfvo_ros.{command}', '--help')
    assert done.returncode == 0 and 'usage' in done.stdout
    imported = {line.rpartition('|')[2].strip() for line in done.stderr.splitlines()}
    assert 'argparse' in imported
    assert not imported & {'numba', 'poselib', 'rosbags', 'tqdm', 'matplotlib', 'rclpy', 'torch'}
