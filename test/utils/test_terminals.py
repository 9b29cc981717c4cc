# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Lines of commands on every terminal: printable, of bounded length, and without UTF-8."""

from __future__ import annotations

import pytest
from command_lines import ENVIRONMENT, run_python

SCRIPT = """
import logging, sys
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.commands import make_parser, run_command

def body(argv):
    {body}

sys.exit(run_command('kfvo_test', body, sys.argv[1:]))
"""


def run(body: str, *arguments: str, **environment: str):
    return run_python('-c', SCRIPT.format(body=body), *arguments, env=ENVIRONMENT | environment)


@pytest.mark.parametrize('encoding', ['ascii', 'ascii:strict', 'latin-1', 'utf-8:strict'])
def test_a_terminal_that_cannot_show_a_letter_gets_its_code(encoding):
    letters = '\\u0142\\u2603' + ('\\udce9' if encoding.startswith('utf-8') else '')
    body = (f'print("{letters}"); logging.getLogger("kfvo_ros").warning("{letters}"); '
            f'raise KfvoError("{letters}")')
    done = run_python('-c', SCRIPT.format(body=body), text=False,
                      env=ENVIRONMENT | {'PYTHONIOENCODING': encoding})
    shown = 'ł☃\\udce9'.encode() if encoding.startswith('utf-8') else b'\\u0142\\u2603'
    assert (done.returncode, done.stdout) == (1, shown + b'\n')
    assert done.stderr == b'kfvo_test: WARNING: %s\nkfvo_test: error: %s\n' % (shown, shown)


@pytest.mark.parametrize('body', [
    'raise KfvoError("{text}")', 'raise OSError("{text}")', 'open("{text}")',
    'logging.getLogger("kfvo_ros").warning("%s", "{text}")',
    'make_parser("kfvo_test", "Test.").parse_args(["{text}"])'])
def test_control_characters_are_escaped(body):
    done = run(body.format(text='a\\x1b[2J\\x07\\x9b\\nb'))
    last = done.stderr.splitlines()[-1]
    assert last.startswith('kfvo_test: ') and r'\x1b[2J\x07\x9b' in last and last.isprintable()


@pytest.mark.parametrize('body', [
    'raise KfvoError({text})', 'raise OSError({text})', 'raise MemoryError({text})',
    'logging.getLogger("kfvo_ros").warning({text})',
    'make_parser("kfvo_test", "Test.").parse_args([{text}])'])
def test_lines_are_short(body):
    done = run(body.format(text='"x" * 100000 + "end"'))
    last = done.stderr.splitlines()[-1]
    assert 450 < len(last) < 550 and last.endswith('end')
