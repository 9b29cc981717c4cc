# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signals: recorded, asked for, and the second that ends a process at once."""

from __future__ import annotations

import signal
import time

import pytest
from command_lines import run_python, started

from kfvo_ros.utils import signals
from kfvo_ros.utils.process import time_limit
from kfvo_ros.utils.signals import SIGNALS, Interrupted, signals_handled


@pytest.mark.parametrize('number', SIGNALS)
def test_a_signal_is_raised_where_it_is_asked_for(number):
    before = signal.getsignal(number)
    with signals_handled():
        assert not signals.interrupted()
        signals.raise_if_interrupted()
        signal.raise_signal(number)
        reached = True
        assert signals.interrupted() and signals.exit_status() == 128 + number
        with pytest.raises(Interrupted, match='^all is kept$'):
            signals.raise_if_interrupted('all is kept')
        with signals_handled():  # nested: as a command that calls another
            assert signals.interrupted()
    assert reached and signal.getsignal(number) == before
    with signals_handled():
        assert not signals.interrupted()


@pytest.mark.parametrize('number', SIGNALS)
def test_an_ignored_signal_is_handled_on_request_but_not_that_of_nohup(number):
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with signals_handled():
            signal.raise_signal(number)
            assert not signals.interrupted()
        with signals_handled(even_ignored=True):
            signal.raise_signal(number)
            assert signals.interrupted() == (number != signal.SIGHUP)
    finally:
        signal.signal(number, before)


def test_library_handlers_do_not_catch_an_interruption():
    assert not issubclass(Interrupted, (Exception, KeyboardInterrupt))


def test_sleep_ends_soon_after_a_signal():
    with signals_handled():
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        previous = signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGTERM))
        try:
            began = time.monotonic()
            with pytest.raises(Interrupted):
                signals.sleep(600.0)
            assert time.monotonic() - began < 60.0
        finally:
            signal.signal(signal.SIGALRM, previous)
        assert signals.exit_status() == 128 + signal.SIGTERM


BUSY = """
import sys, time
from kfvo_ros.utils import signals
with signals.signals_handled():
    print('ready', flush=True)
    while True:
        time.sleep(0.01)
        if signals.interrupted():
            print('first', flush=True)
            break
    time.sleep(600)
"""


@pytest.mark.parametrize('number', SIGNALS)
def test_the_second_of_a_kind_ends_the_process_at_once(number):
    with started('-c', BUSY) as process:
        assert process.stdout.readline() == 'ready\n'
        process.send_signal(number)
        process.send_signal(number)  # a parent may repeat what the terminal sends
        assert process.stdout.readline() == 'first\n'
        time.sleep(2.0 * signals.BOUNCE_S)
        assert process.poll() is None
        process.send_signal(number)
        assert process.wait(time_limit(60.0)) == 128 + number


DONE = """
import signal, sys
from kfvo_ros.utils.commands import run_command
sys.argv = ['kfvo_test']
status = run_command('kfvo_test', lambda argv: print('done'), None)
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.raise_signal(number)
sys.exit(status)
"""


def test_a_signal_after_the_work_changes_no_status():
    done = run_python('-c', DONE)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'done\n', '')
