# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands: exit status, error messages, signals, --help, and lists of values."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from command_lines import ENVIRONMENT, one_readable_line, run_interrupted, run_python

import kfvo_ros
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences import open_sequence
from kfvo_ros.utils.commands import MAX_SEEDS, expand_ranges, parse_names, parse_numbers
from kfvo_ros.utils.signals import SIGNALS

COMMANDS = ('run', 'convert', 'play', 'node', 'demo', 'train', 'ablation', 'benchmark')
LIGHT_COMMANDS = ('run', 'convert', 'play', 'demo', 'train', 'benchmark')
SCRIPT = """
import logging, os, signal, sys, time
import numpy as np
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils import signals

def body(argv):
    {body}

{before}
sys.exit(run_command('kfvo_test', body, sys.argv[1:], until_stopped={until_stopped}))
"""


def script(body: str, until_stopped: bool = False, before: str = '') -> list[str]:
    """Return arguments of Python for a command with this body of one line."""
    return ['-c', SCRIPT.format(body=body, until_stopped=until_stopped, before=before)]


def test_success():
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
def test_user_errors_are_one_line(body, line):
    done = run_python(*script(body))
    assert done.returncode == 1
    assert one_readable_line(done).startswith(f'kfvo_test: error: {line}')


@pytest.mark.parametrize(('body', 'last_line'), [
    ('1 / 0', 'ZeroDivisionError: division by zero'),
    ('import kfvo_ros.none', "ModuleNotFoundError: No module named 'kfvo_ros.none'")])
def test_bugs_keep_their_traceback(body, last_line):
    done = run_python(*script(body))
    assert done.returncode == 1 and 'Traceback' in done.stderr
    assert done.stderr.splitlines()[-1] == last_line


@pytest.mark.parametrize('body', ['print("result")', 'print("result" * 10000)',
                                  'make_parser("kfvo_test", "Test.").parse_args(["--help"])'])
def test_stdout_that_cannot_be_written_is_an_error(body):
    environment = ENVIRONMENT | {'PYTHONUNBUFFERED': ''}  # argparse ignores errors of stdout then
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
@pytest.mark.parametrize('sent', SIGNALS)
def test_signals(sent, until_stopped, tmp_path: Path):
    started = tmp_path / 'started'
    body = f'open({str(started)!r}, "x"); signals.sleep(60)'
    status, output, problems = run_interrupted(sent, started.exists,
                                               *script(body, until_stopped))
    assert (status, output) == ((0, '') if until_stopped else (128 + sent, ''))
    assert problems == ('' if until_stopped else 'kfvo_test: error: interrupted\n')


@pytest.mark.parametrize('until_stopped', [False, True])
def test_an_ignored_signal(until_stopped):
    """Background jobs of shell scripts ignore SIGINT."""
    body = ('signal.raise_signal(signal.SIGINT); signals.raise_if_interrupted(); '
            'print("went on")')
    done = run_python(*script(body, until_stopped,
                              'signal.signal(signal.SIGINT, signal.SIG_IGN)'))
    assert done.returncode == 0, done.stderr
    assert done.stdout == ('' if until_stopped else 'went on\n')


@pytest.mark.parametrize('command', COMMANDS)
def test_version_and_invalid_arguments(command):
    if command == 'node':
        pytest.importorskip('rclpy', reason='rclpy is not installed')
    done = run_python('-m', f'kfvo_ros.{command}', '--version')
    assert (done.returncode, done.stdout) == (0, f'kfvo_ros {kfvo_ros.__version__}\n')
    done = run_python('-m', f'kfvo_ros.{command}', '--no-such-option')
    assert done.returncode == 2
    assert re.match(rf'kfvo_{command}: error: ', one_readable_line(done))


@pytest.mark.parametrize('command', LIGHT_COMMANDS)
def test_help_without_slow_imports(command):
    done = run_python('-X', 'importtime', '-m', f'kfvo_ros.{command}', '--help')
    assert done.returncode == 0 and 'usage' in done.stdout
    imported = {line.rpartition('|')[2].strip() for line in done.stderr.splitlines()}
    assert 'argparse' in imported
    assert not imported & {'numba', 'poselib', 'rosbags', 'tqdm', 'matplotlib', 'rclpy', 'torch'}


def test_expand_ranges():
    texts = expand_ranges(['synthetic:8-10:fast', 'a/path-3-4', 'synthetic:7', 'synthetic:2-2'])
    assert texts == ('synthetic:8:fast', 'synthetic:9:fast', 'synthetic:10:fast', 'a/path-3-4',
                     'synthetic:7', 'synthetic:2')
    assert open_sequence(texts[0]).name == 'synthetic:8:fast'


@pytest.mark.parametrize('text', ['synthetic:4-3', f'synthetic:0-{MAX_SEEDS}'])
def test_empty_and_long_ranges_are_errors(text):
    with pytest.raises(KfvoError, match=f'expected synthetic:A-B.*{text}'):
        expand_ranges([text])


def test_parse_names_and_numbers():
    assert parse_names('b,a,b', 'letters', ('a', 'b', 'c')) == ('b', 'a')
    assert parse_numbers('2,1,2', 'seeds') == (2, 1)
    with pytest.raises(KfvoError, match="letters: expected names out of a, b, came 'd'"):
        parse_names('a,d', 'letters', ('a', 'b'))
    for text in ('', '1,', '1.5', '-1', '²', '0', '1' + '0' * 30, '9' * 5000):
        with pytest.raises(KfvoError, match='workers: expected whole numbers from 1'):
            parse_numbers(text, 'workers', 1)
