# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What tests start ends with them, also after a failure."""

from __future__ import annotations

import subprocess
import time

import pytest
from command_lines import is_running, leftovers, run_python, started

from kfvo_ros.utils.process import time_limit

PARENT = """
import subprocess, sys
child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])
print(child.pid, flush=True)
if sys.argv[1] == 'wait':
    child.wait()
"""


@pytest.mark.parametrize('parent', ['wait', 'leave'])
def test_a_failure_ends_the_process_and_its_children(parent):
    with pytest.raises(AssertionError), started('-c', PARENT, parent) as process:
        child = int(process.stdout.readline())
        assert is_running(child)
        raise AssertionError
    assert process.returncode is not None and leftovers(time_limit(5.0)) == {}
    end = time.monotonic() + time_limit(5.0)
    while is_running(child) and time.monotonic() < end:  # killed, and about to end
        time.sleep(0.02)
    assert not is_running(child)


def test_too_long_a_command_is_ended(monkeypatch):
    monkeypatch.setenv('KFVO_TIME_FACTOR', '0.001')
    with pytest.raises(subprocess.TimeoutExpired):
        run_python('-c', 'import time; time.sleep(600)', timeout_s=100.0)
    monkeypatch.delenv('KFVO_TIME_FACTOR')
    assert leftovers(time_limit(5.0)) == {}


def test_processes_that_are_left_are_found():
    with started('-c', PARENT, 'leave') as process:
        child = int(process.stdout.readline())
        process.wait()
        found = leftovers(0.1)
        assert list(found) == [child] and 'time.sleep(600)' in found[child]
